"""Derivatives of the discretized system by JAX: first order, second order backward and forward, Gauss-Newton."""
