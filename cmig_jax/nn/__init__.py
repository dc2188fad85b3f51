"""Layers that networks share: plain linen modules with typed fields, without losses and without the flags of a network."""
