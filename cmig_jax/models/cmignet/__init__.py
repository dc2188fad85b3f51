"""CMIGNet (Xie et al., RA-L 2023): `flags`, `network` (Fig. 2, read top-down), `keypoints`, `heads`, `losses`; `model` joins them."""
