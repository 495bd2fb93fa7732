"""Translate JAX functions to scalar operations: `trace` interprets a jaxpr, with object arrays of nodes for arrays.

`moves`, `meanings` and `rules` say what its operations do: to the places of entries, to each entry, to whole arrays.
"""
