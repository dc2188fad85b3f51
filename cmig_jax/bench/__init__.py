"""Ours beside the PyTorch twin on the same machine: time by stage, compile time, peak memory (`python -m cmig_jax.bench`).

`cases` says what is measured, `ours` and `parity.twin_bench` do the same work, `worker` holds each in a process of its own, `clock` takes
turns between them, `memory` is how much they held, `clouds` registers ever larger clouds.
"""
