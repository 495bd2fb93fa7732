"""How the discretised system is computed: by machine code of our own (`native`) or by JAX (`jax`), and which of them.

Imports `runtime`, `problem` and `discretization`. `adaptive` solves with step size control and chooses the mesh.
"""
