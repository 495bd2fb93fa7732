"""Stiff modes, in problems of one mode."""

import jax.numpy as jnp

import switchfit as sf
from support.models import one_run

SQUARE = sf.RunningCost(lambda t, x, p: x[0] ** 2)


def van_der_pol(t, x, p):
    return jnp.array([x[1], p["mu"] * (1.0 - x[0] ** 2) * x[1] - x[0]])


def robertson(t, x, p):
    first, second, third = p["a"] * x[0], p["c"] * x[1] ** 2, p["b"] * x[1] * x[2]
    return jnp.array([third - first, first - third - second, second])


def one_mode(mode, start, parameters, tf, data=SQUARE, *, solver="stiff", **settings):
    return one_run(sf.HybridSystem({"m": mode}, start), data, ("m",), (), tf, parameters, solver=solver, **settings)
