"""The PyTorch twin, weights both ways, and the numbers side by side (extra `[parity]`: the only place that imports torch).

`twin` is the released network in plain PyTorch and `twin_run` runs it; `recorded` is the format of recorded cases; `layout` and
`weights` map its state to Flax variables, `files` and `convert` do so for files; `check` holds the Flax network to a case (from end to
end, or `stages` by stage), `compare` to the live twin. `python -m cmig_jax.parity --help`.
"""
