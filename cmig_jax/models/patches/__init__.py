"""The patch transformer, the network that comes with the package: `flags`, and `network`, which reads top-down."""
