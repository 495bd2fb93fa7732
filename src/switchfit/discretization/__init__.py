"""The discretized system: tableaus, rows and their equations, meshes, the arrays of an experiment, the forward pass.

Imports `runtime` and `problem`. Written for one experiment, as pure functions: `rows` for NumPy and graphs of scalars,
`propagation` for JAX.
"""
