"""Networks: a file or a folder each, with its flags and losses; `base` has what the rest of the package knows, `networks` lists them.

Nothing here imports JAX: a network's flags are read before JAX starts.
"""
