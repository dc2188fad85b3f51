"""Training: the only room where data, network and losses meet."""
