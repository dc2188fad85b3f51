"""IDAM (Li et al., ECCV 2020) with its graph network: `flags`, and `network`, which reads top-down."""
