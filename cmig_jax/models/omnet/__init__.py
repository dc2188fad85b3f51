"""OMNet (Xu et al., ICCV 2021): overlap masks and a regressed pose: `flags`, and `network`, which reads top-down."""
