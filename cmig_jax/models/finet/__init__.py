"""FINet (Xu et al., AAAI 2022): branches for rotation and translation: `flags`, and `network`, which reads top-down."""
