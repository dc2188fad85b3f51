"""RPM-Net (Yew and Lee, CVPR 2020): `flags`, and `network`, which reads top-down."""
