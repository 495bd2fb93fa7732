"""The simulation of `switchfit.discretization.propagation` and its derivatives, by JAX alone: the plain reference."""
