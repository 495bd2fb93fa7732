"""Evaluate the discretized system: in machine code (`native`) or by JAX (`jax`); `choice` decides which.

Imports `runtime`, `problem` and `discretization`. `adaptive` chooses the mesh.
"""
