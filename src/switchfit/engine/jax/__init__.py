"""Derivatives of the discretised system by JAX: of first order, second order backward and forward, Gauss-Newton."""
