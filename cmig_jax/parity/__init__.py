"""CMIGNet beside the released PyTorch network: weights both ways, and the numbers side by side. `cmig parity --help`.

For any network: `cases` is the format of recorded cases, `rows` compares, `weights` maps a state to Flax variables by a layout,
`torch_files` reads and writes PyTorch files. For CMIGNet: `cmignet_layout` is its state, `cmignet_run` runs it and watches its stages,
`cmignet_check` holds it to a case, `cmignet_ties` names rounding ties, `cmignet_twin` is the network in PyTorch and `cmignet_compare`
the live comparison; `convert` converts its weights. Another network adds a layout, a run and a check. Only `torch_files`,
`cmignet_twin*` and what imports them need PyTorch (extra `[parity]`).
"""
