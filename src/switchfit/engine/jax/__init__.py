"""JAX as an engine, the plain reference: for any model, on any device.

It differentiates the simulation of `switchfit.discretization.propagation` as it is: no equation of derivatives is
written twice.
"""
