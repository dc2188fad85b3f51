"""Speed and memory of a network beside its PyTorch reference on the same machine (`cmig bench`).

`cases` says what is measured; `ours` and the reference do the same work; `worker` holds each in its own process, `clock` takes turns
between them, `run` measures time, memory, and larger and larger clouds with our network alone; `tables` prints.
"""
