"""The network's modules (Fig. 2): linen, plain typed fields, no losses, no config objects; `build` alone reads the flags."""
