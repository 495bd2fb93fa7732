"""Evaluate the discretized system: in machine code (`native`) or by JAX (`jax`); `choice` decides which.

Imports `runtime`, `problem` and `discretization`. Engines take a `run` and return an `evaluation` or a `simulation`.
`adaptive` solves an experiment with step size control; `corners` are modes whose functions have corners in the state.
"""
