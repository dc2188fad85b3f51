"""PCRNet: the network, its flags and its losses."""
