"""Libraries of modes, and the modes of the searches."""

from __future__ import annotations

import jax.numpy as jnp

from switchfit.strategy.library import Library


def make_library(modes="abc", successions=None, most=8, durations=None, first=None, last=None):
    """Return the library of modes that may follow each other freely, unless `successions` says otherwise."""
    names = tuple(modes)
    followers = {m: tuple(n for n in names if n != m) for m in names} if successions is None else successions
    followers = {m: tuple(followers.get(m, ())) for m in names}
    lasting = {m: (durations or {}).get(m, 0.0) for m in names}
    return Library(names, tuple(first or names), tuple(last or names), followers, lasting, most)


def rise(t, x, p):
    return p["rate"] * jnp.stack([1.0 - x[0], -x[1]])


def fall(t, x, p):
    return p["rate"] * jnp.stack([-x[0], -x[1]])


def pull(t, x, p):
    return jnp.stack([-p["rate"] * x[0], p["force"] - x[1]])
