"""Operations that are computed in two ways: `plain`, a few lines with JAX's own derivative, and `fast`, with a hand-written derivative.

The fast versions are written for a CPU; `compute.kernels` chooses (`kernels.is_fast`). Both give the same values and derivatives up to
rounding, except where noted for ties of a maximum. `tests/ops/test_plain_and_fast.py` compares them.
"""
