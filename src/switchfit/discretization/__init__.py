"""The discretized system: tableaus, the mesh and its rows, the arrays of an experiment, the forward pass.

Imports `runtime` and `problem`. Written in JAX, for one experiment, as pure functions.
"""
