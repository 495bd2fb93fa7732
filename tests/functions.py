"""Functions that a model might use, from (3,) to an array: everything in jax.numpy, lax, jax.nn, jax.scipy.special.

`FALLS_BACK` says of which JAX has to do the work, and what the reason begins with. All others must become machine code.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, nn
from jax.scipy import special

Function = Callable[[Any], Any]

TABLE_T = np.array([-2.0, -0.5, 0.0, 0.7, 1.1, 3.0])
TABLE_Y = np.array([1.0, 0.3, -0.2, 0.5, 0.9, -1.0])
AWAY = lax.RoundingMethod.AWAY_FROM_ZERO
A = np.array([[2.0, 0.3, -0.1], [0.3, 1.5, 0.2], [-0.1, 0.2, 3.0]])


@jax.custom_jvp
def friction(v):
    return jnp.tanh(5.0 * v)


@friction.defjvp
def _friction_jvp(primals, tangents):
    (v,), (d,) = primals, tangents
    return friction(v), 5.0 * (1.0 - friction(v) ** 2) * d


@jax.custom_vjp
def saturated(v):
    return jnp.arctan(v)


saturated.defvjp(lambda v: (jnp.arctan(v), v), lambda v, g: (g / (1.0 + v * v),))


@jax.jit
def inner(x):
    return jnp.sin(x) * x[0]


@partial(jax.jit, static_argnums=1)
def powered(x, k):
    return x**k


@jax.checkpoint
def remade(x):
    return jnp.exp(jnp.sin(x))


def pick(x, k):
    return x[k]


def newton(x):
    """A fixed number of Newton steps for y + y**3 = x."""
    return lax.fori_loop(0, 4, lambda _, y: y - (y + y**3 - x) / (1 + 3 * y**2), x)


def taylor(x):
    def term(carry, k):
        power, total = carry
        power = power * x / k
        return (power, total + power), None

    return lax.scan(term, (jnp.ones(3), jnp.ones(3)), jnp.arange(1.0, 12.0))[0][1]


ARITHMETIC: dict[str, Function] = {
    "add": lambda x: x + 2 * x[::-1] - 1.5,
    "divide": lambda x: 1 / x + x / 3.0,
    "divide by itself": lambda x: x / (x[0] - x[0]),
    "power 3": lambda x: x**3,
    "power -2": lambda x: x**-2,
    "power 0": lambda x: x**0 + x,
    "power 1/2": lambda x: x**0.5,
    "power of a state": lambda x: jnp.abs(x) ** x[0],
    "power of a negative": lambda x: x ** x[1],
    "float_power": lambda x: jnp.float_power(jnp.abs(x) + 0.1, 1.3),
    "floor division": lambda x: x // 0.3,
    "mod": lambda x: x % 0.4,
    "mod of a negative": lambda x: (-x) % 0.4,
    "remainder": lambda x: jnp.remainder(x, x[::-1] + 2.0),
    "fmod": lambda x: jnp.fmod(x, 0.4),
    "divmod": lambda x: jnp.stack(jnp.divmod(x, 0.7)),
    "modf": lambda x: jnp.stack(jnp.modf(3 * x)),
    "reciprocal": jnp.reciprocal,
    "square": jnp.square,
    "negative": lambda x: -(1.0 - (-x)),
    "positive": lambda x: +x * 1.0,
    "integer_pow": lambda x: lax.integer_pow(x, 5),
    "fma": lambda x: x * x + x,
    "fractions of small": lambda x: (x + 1e-300) * 1e300,
    "overflow": lambda x: jnp.exp(800 * x),
    "underflow": lambda x: jnp.exp(-800 * x),
}

ELEMENTARY: dict[str, Function] = {
    **{
        name: getattr(jnp, name)
        for name in (
            *("sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "sinh", "cosh", "arctan", "arcsinh", "expm1", "log1p"),
            *("cbrt", "exp2", "log2", "log10", "sinc", "deg2rad", "rad2deg", "abs", "arcsin", "arccos", "arctanh"),
        )
    },
    "arccosh": lambda x: jnp.arccosh(1 + x),
    "arctan2": lambda x: jnp.arctan2(x, x[::-1]),
    "hypot": lambda x: jnp.hypot(x, 2 * x[0]),
    "logaddexp": lambda x: jnp.logaddexp(x, 2 * x[0]),
    "logaddexp2": lambda x: jnp.logaddexp2(x, 2 * x[0]),
    "rsqrt": lax.rsqrt,
    "angle": lambda x: jnp.unwrap(2 * x),
    "log of abs": lambda x: jnp.log(jnp.abs(x)),
    "guarded log": lambda x: jnp.where(x > 0, jnp.log(jnp.where(x > 0, x, 1.0)), 0.0),
    "unguarded sqrt": lambda x: jnp.where(x > 0, jnp.sqrt(x), 0.0),
    "i0": lambda x: jnp.i0(x),
    "nan_to_num": lambda x: jnp.nan_to_num(jnp.log(x), nan=3.0),
}

ROUNDING: dict[str, Function] = {
    "round": lambda x: jnp.round(3 * x) * x,
    "round 1 digit": lambda x: jnp.round(x, 1),
    "round away": lambda x: lax.round(
        x + np.array([0.5, 0.49999999999999994, -0.5]), lax.RoundingMethod.AWAY_FROM_ZERO
    ),
    "floor": lambda x: jnp.floor(3 * x) * x,
    "ceil": lambda x: jnp.ceil(3 * x) * x,
    "trunc": lambda x: jnp.trunc(3 * x) * x,
    "rint": lambda x: jnp.rint(x + 0.5) * x,
    "sign": lambda x: jnp.sign(x - 0.8) * x,
    "sign of zero": lambda x: jnp.sign(x * 0.0) + x,
    "copysign": lambda x: jnp.copysign(x, x[::-1]),
    "signbit": lambda x: jnp.where(jnp.signbit(x), 1.0, 2.0) * x,
    "fix": lambda x: jnp.trunc(x * 2.5),
    "sawtooth": lambda x: x - jnp.floor(x),
    "triangle": lambda x: jnp.abs((x % 1.0) - 0.5),
    "square wave": lambda x: jnp.where((x % 1.0) < 0.5, 1.0, -1.0) * x,
}

DECISIONS: dict[str, Function] = {
    "where": lambda x: jnp.where(x > 0.7, x**2, jnp.sin(x)),
    "where of booleans": lambda x: jnp.where(jnp.where(x > 0.7, x > 1, x < 0.3), x, 2 * x),
    "comparison of booleans": lambda x: jnp.where((x > 0.7) == (x[::-1] > 0.7), x, -x),
    "booleans unequal": lambda x: jnp.where((x > 0.7) != (x < 1), x, -x),
    "booleans less": lambda x: jnp.where((x > 0.7) < (x < 1), x, -x),
    "booleans less or equal": lambda x: jnp.where((x > 0.7) <= (x < 1), x, -x),
    "booleans greater": lambda x: jnp.where((x > 0.7) > (x < 1), x, -x),
    "booleans greater or equal": lambda x: jnp.where((x > 0.7) >= (x < 1), x, -x),
    "max of booleans": lambda x: jnp.where(jnp.maximum(x > 0.7, x < 0.3), x, -x),
    "min of booleans": lambda x: jnp.where(jnp.minimum(x > 0.3, x < 0.9), x, -x),
    "greatest boolean": lambda x: jnp.where(jnp.max(x > 1.0), x, -x),
    "least boolean": lambda x: jnp.where(jnp.min(x > 0.1), x, -x),
    "xor": lambda x: jnp.where((x > 0.7) ^ (x < 1), x, -x),
    "logical_xor": lambda x: jnp.where(jnp.logical_xor(x > 0.7, x), x, -x),
    "not": lambda x: jnp.where(~(x > 0.7), x, -x),
    "logical_not of numbers": lambda x: jnp.where(jnp.logical_not(x), 1.0, x),
    "and, or": lambda x: jnp.where((x > 0.2) & (x < 0.9) | (x > 1.2), x, -x),
    "any": lambda x: jnp.any(x > 1) * x,
    "all": lambda x: jnp.all(x > 0.1) * x,
    "count": lambda x: jnp.sum(x > 0.5) * x,
    "mean of booleans": lambda x: jnp.mean(x > 0.5) * x,
    "product of booleans": lambda x: jnp.prod(x > 0.5) * x,
    "cumulated booleans": lambda x: jnp.cumsum(x > 0.5) * x,
    "count_nonzero": lambda x: jnp.count_nonzero(x > 0.5) * x,
    "boolean as a number": lambda x: (x > 0.5) * x + (x < 1.0).astype(float),
    "boolean as an integer": lambda x: (x > 0.5).astype(int) * x,
    "integer as a boolean": lambda x: jnp.where((x > 0.5).astype(int).astype(bool), x, -x),
    "number as a boolean": lambda x: jnp.where(x.astype(bool), x, 7.0),
    "plus or minus one": lambda x: jnp.where(x > 0.7, 1, -1) * x,
    "integer arithmetic": lambda x: (2 * (x > 0.7) - 1) * x,
    "integers compared": lambda x: jnp.where(jnp.sum(x > 0.5) >= 2, x, -x),
    "integers chosen": lambda x: jnp.minimum(jnp.where(x > 0.7, 3, 5), jnp.sum(x > 0)) * x,
    "integer division": lambda x: (jnp.where(x > 0.7, 7, 5) // 2) * x,
    "integer remainder": lambda x: (jnp.where(x > 0.7, 7, 5) % 4) * x,
    "bits": lambda x: (jnp.where(x > 0.7, 7, 5) & 6) * x,
    "shift": lambda x: (jnp.where(x > 0.7, 7, 5) << 2) * x,
    "small integers": lambda x: (x > 0.7).astype(jnp.int8) * x,
    "unsigned integers": lambda x: (x > 0.7).astype(jnp.uint32) * x,
    "integer powers": lambda x: (jnp.where(x > 0.7, 7, 5) ** 2) * x,
    "large integers": lambda x: jnp.where(x > 0.7, 2**31, 5) * (jnp.where(x > 0.1, 2**33, 1)) * x,
    "truncated": lambda x: (3 * x).astype(int) * x,
    "clip": lambda x: jnp.clip(x, 0.5, 1.0),
    "clip from below": lambda x: jnp.clip(x, min=0.5) * x,
    "clamp": lambda x: lax.clamp(0.3, x, 0.9),
    "clamp by states": lambda x: lax.clamp(0.5 * x, x**2, 1.5 * x),
    "maximum": lambda x: jnp.maximum(x, 0.8) * x,
    "minimum": lambda x: jnp.minimum(x, x[::-1]) * x,
    "fmax": lambda x: jnp.fmax(x, 0.8),
    "fmin": lambda x: jnp.fmin(x, 0.8),
    "heaviside": lambda x: jnp.heaviside(x - 0.8, 0.5) * x,
    "select": lambda x: jnp.select([x < 0.5, x < 1.0], [x, x**2], jnp.cos(x)),
    "piecewise": lambda x: jnp.piecewise(x, [x < 0.5, x >= 1.0], [jnp.sin, lambda v: v**2, lambda v: v]),
    "select_n": lambda x: lax.select_n((x > 0.5).astype(jnp.int32) + (x > 1), x, x**2, x**3),
    "isfinite": lambda x: jnp.where(jnp.isfinite(1 / x), x, 0.0),
    "isnan": lambda x: jnp.where(jnp.isnan(jnp.log(x)), 1.0, x),
    "isinf": lambda x: jnp.where(jnp.isinf(1 / x), 2.0, x),
    "isclose": lambda x: jnp.where(jnp.isclose(x, x[0]), x, -x),
    "array_equal": lambda x: jnp.where(jnp.array_equal(x, x[::-1]), x, -x),
    "deadzone": lambda x: jnp.sign(x) * jnp.maximum(jnp.abs(x) - 0.5, 0.0),
    "cond": lambda x: lax.cond(x[0] > 0.8, lambda v: 2 * v, jnp.sin, x),
    "cond of booleans": lambda x: jnp.where(lax.cond(x[0] > 0.8, lambda v: v > 1, lambda v: v < 1, x), x, -x),
    "cond of integers": lambda x: lax.cond(x[0] > 0.8, lambda: 2, lambda: 3) * x,
    "cond of several": lambda x: sum(lax.cond(x[0] > 0.8, lambda v: (v, v**2), lambda v: (v**3, 1.0 * v), x)),
    "cond of something known": lambda x: lax.cond(True, jnp.sin, jnp.cos, x),
    "switch": lambda x: lax.switch(1, [jnp.sin, jnp.cos], x),
    "switch by the state": lambda x: lax.switch((3 * x[0]).astype(int), [jnp.sin, jnp.cos, jnp.exp], x),
    "integers of all kinds": lambda x: (
        ((3 * x).astype(int) // 2 + (5 * x).astype(int) % 3 - (7 * x).astype(int) ** 2 + abs((-3 * x).astype(int))) * x
    ),
    "division of integers by zero": lambda x: lax.div((30 * x).astype(int), (3 * x).astype(int)) * x,
    "remainder of integers by zero": lambda x: lax.rem((30 * x).astype(int), (3 * x).astype(int)) * x,
    "integers have no negative zero": lambda x: jnp.arctan2(((0.4 * x).astype(int) * -3).astype(float), -1.0) * x,
    "integers of NaN": lambda x: jnp.where(x > 0.5, x, jnp.nan).astype(int) * x,
    "switch by a count": lambda x: lax.switch(jnp.sum(x > 0.5), [jnp.sin, jnp.cos, jnp.exp], x),
    "nested cond": lambda x: lax.cond(
        x[0] > 0.5, lambda v: lax.cond(v[1] > 0.5, jnp.sin, jnp.cos, v), lambda v: v**2, x
    ),
    "cond in vmap": lambda x: jax.vmap(lambda v: lax.cond(v > 0.5, jnp.sin, jnp.cos, v))(x),
    "hysteresis": lambda x: lax.scan(lambda s, v: ((s & (v > 0.3)) | (v > 0.9),) * 2, x[0] > 0.5, x)[1] * x,
}

ARRAYS: dict[str, Function] = {
    "matrix": lambda x: A @ x,
    "quadratic form": lambda x: x @ A @ x,
    "outer": lambda x: jnp.outer(x, x),
    "inner": lambda x: jnp.inner(x, 2 * x) * x,
    "cross": lambda x: jnp.cross(x, x[::-1] ** 2),
    "kron": lambda x: jnp.kron(x, x),
    "einsum": lambda x: jnp.einsum("i,ij,j->i", x, A, x),
    "einsum of a batch": lambda x: jnp.einsum("bi,bj->bij", A * x, A),
    "tensordot": lambda x: jnp.tensordot(A * x, A, axes=[[0], [1]]),
    "matrix_power": lambda x: jnp.linalg.matrix_power(A * x, 3),
    "norm": lambda x: jnp.linalg.norm(x) * x,
    "norm 1": lambda x: jnp.linalg.norm(x, 1) * x,
    "norm inf": lambda x: jnp.linalg.norm(x, jnp.inf) * x,
    "vector_norm": lambda x: jnp.linalg.vector_norm(A * x),
    "trace": lambda x: jnp.trace(A * x) * x,
    "det": lambda x: jnp.linalg.det(A * x[0] + jnp.outer(x, x)) * x,
    "inv": lambda x: jnp.linalg.inv(A + jnp.outer(x, x)),
    "solve": lambda x: jnp.linalg.solve(A + jnp.outer(x, x), x),
    "solve with a known matrix": lambda x: jnp.linalg.solve(A, x),
    "cholesky": lambda x: jnp.linalg.cholesky(A + jnp.outer(x, x)),
    "eigh": lambda x: jnp.linalg.eigh(A + jnp.outer(x, x))[0],
    "svd": lambda x: jnp.linalg.svd(A + jnp.outer(x, x), compute_uv=False),
    "qr": lambda x: jnp.linalg.qr(A + jnp.outer(x, x))[1],
    "expm": lambda x: jax.scipy.linalg.expm(0.1 * A * x),
    "sum": lambda x: jnp.sum(x) * x,
    "sum of an axis": lambda x: (A * x).sum(0),
    "sum of nothing": lambda x: jnp.sum(x[:0]) + x,
    "product of nothing": lambda x: jnp.prod(x[3:]) * x,
    "dot of nothing": lambda x: x[:0] @ x[3:] + x,
    "matrix of nothing": lambda x: jnp.zeros((3, 0)) @ x[:0] + x,
    "max of nothing": lambda x: jnp.maximum(jnp.max(x[:0], initial=-1.0), x),
    "any of nothing": lambda x: jnp.where(jnp.any(x[:0] > 1), x, -x),
    "all of nothing": lambda x: jnp.where(jnp.all(x[:0] > 1), x, -x),
    "concatenated with nothing": lambda x: jnp.concatenate([x[:0], x, x[3:]]),
    "where of nothing": lambda x: jnp.sum(jnp.where(x[:0] > 1, x[:0], 0.0)) * x,
    "mean": lambda x: x - jnp.mean(x),
    "var": lambda x: jnp.var(x) * x,
    "std": lambda x: jnp.std(x) * x,
    "max": lambda x: jnp.max(x) * x,
    "min": lambda x: jnp.min(A * x, axis=1),
    "ptp": lambda x: jnp.ptp(x) * x,
    "prod": lambda x: jnp.prod(x) * x,
    "cumsum": jnp.cumsum,
    "cumsum reversed": lambda x: lax.cumsum(x, reverse=True),
    "cumprod": jnp.cumprod,
    "cummax": lambda x: lax.cummax(x),
    "cummin": lambda x: lax.cummin(x),
    "cumlogsumexp": lambda x: lax.cumlogsumexp(x),
    "diff": lambda x: jnp.diff(x, prepend=0.0),
    "trapezoid": lambda x: jnp.trapezoid(x, dx=0.1) * x,
    "gradient": lambda x: jnp.gradient(x, 0.1),
    "convolve": lambda x: jnp.convolve(x, np.array([0.2, 0.5, 0.3]), mode="same"),
    "correlate": lambda x: jnp.correlate(x, x, mode="full"),
    "polyval": lambda x: jnp.polyval(np.array([1.0, -2.0, 0.5]), x),
    "polyval of states": lambda x: jnp.polyval(x, x[0]),
    "sort": jnp.sort,
    "argsort": lambda x: x[jnp.argsort(x)],
    "argmax": lambda x: x[jnp.argmax(x)] * x,
    "which is largest": lambda x: jnp.where(jnp.argmax(x) == 1, x, -x) * jnp.argmin(1 / x),
    "median": lambda x: jnp.median(x) * x,
    "quantile": lambda x: jnp.quantile(x, 0.3) * x,
    "top_k": lambda x: lax.top_k(x, 2)[0],
    "searchsorted": lambda x: jnp.searchsorted(TABLE_T, x) * x,
    "interp": lambda x: jnp.interp(x, TABLE_T, TABLE_Y),
    "interp by hand": lambda x: sum(
        jnp.where((x >= a) & (x < b), p + (q - p) * (x - a) / (b - a), 0.0)
        for a, b, p, q in zip(TABLE_T[:-1], TABLE_T[1:], TABLE_Y[:-1], TABLE_Y[1:], strict=True)
    ),
    "interp by hats": lambda x: jnp.sum(TABLE_Y * jnp.maximum(1 - jnp.abs(x[:, None] - np.arange(6.0)), 0.0), axis=1),
    "map_coordinates": lambda x: jax.scipy.ndimage.map_coordinates(jnp.asarray(TABLE_Y), [x], order=1),
    "fft": lambda x: jnp.abs(jnp.fft.fft(x)),
    "complex": lambda x: jnp.real((x + 1j) * (x - 2j)),
    "vander": lambda x: jnp.vander(x, 4),
    "tri": lambda x: jnp.tril(A * x) + jnp.triu(A * x, 1),
    "block": lambda x: jnp.block([[x[:2], x[2:]], [x[:1], x[1:]]]),
    "meshgrid": lambda x: jnp.stack(jnp.meshgrid(x, x)),
    "skew": lambda x: jnp.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]]) @ x,
}

PLACES: dict[str, Function] = {
    "index": lambda x: x[jnp.array([2, 0, 2])],
    "negative index": lambda x: x[-1] * x,
    "slice": lambda x: x[::2],
    "reversed": lambda x: x[::-1] * x,
    "matrix index": lambda x: (A * x)[1, 1:],
    "columns": lambda x: (A * x)[:, jnp.array([1, 0])],
    "known mask": lambda x: x[np.array([True, False, True])],
    "at set": lambda x: x.at[1].set(5.0),
    "at set of several": lambda x: x.at[jnp.array([0, 2])].set(x[1]),
    "at add": lambda x: x.at[1].add(x[0]),
    "at add twice": lambda x: x.at[jnp.array([2, 0, 2])].add(x),
    "at multiply": lambda x: x.at[1].multiply(x[0]),
    "at max": lambda x: x.at[1].max(0.7),
    "at get with a fill": lambda x: x.at[jnp.array([0, 5])].get(mode="fill", fill_value=0.0),
    "index out of range": lambda x: x[jnp.array([0, 7])],
    "take": lambda x: jnp.take(x, jnp.array([1, 1, 0])),
    "take_along_axis": lambda x: jnp.take_along_axis(A * x, np.array([[0], [2], [1]]), axis=1),
    "boolean index": lambda x: x[(x[0] > 0.5).astype(int)] * x,
    "dynamic_slice": lambda x: lax.dynamic_slice(x, (1,), (2,)),
    "dynamic_slice by the state": lambda x: lax.dynamic_slice(x, (jnp.sum(x > 0.5),), (1,)),
    "dynamic_slice of a matrix by the state": lambda x: lax.dynamic_slice(
        jnp.outer(x, x), (jnp.argmax(x), jnp.argmin(x)), (2, 1)
    ),
    "dynamic_update_slice by the state": lambda x: lax.dynamic_update_slice(
        jnp.outer(x, x), 3 * jnp.outer(x, x)[:2, :2], (jnp.argmax(x), jnp.sum(x > 1))
    ),
    "take by the state": lambda x: jnp.take(x, (3 * x).astype(int)),
    "take wrapped": lambda x: jnp.take(x, (3 * x).astype(int), mode="wrap"),
    "take of columns": lambda x: jnp.take(jnp.outer(x, x), (3 * x).astype(int), axis=1, mode="clip"),
    "take_along_axis by the state": lambda x: jnp.take_along_axis(
        jnp.outer(x, jnp.sin(x)), jnp.argsort(jnp.outer(x, x), axis=1), axis=1
    ),
    "at get with a fill by the state": lambda x: x.at[(3 * x).astype(int)].get(mode="fill", fill_value=2.5),
    "at get with NaN by the state": lambda x: x.at[(3 * x).astype(int)].get(mode="fill"),
    "at set by the state": lambda x: x.at[(3 * x[0]).astype(int)].set(9 * x[1]),
    "at add by the state": lambda x: x.at[(3 * x).astype(int)].add(x**2),
    "at multiply by the state": lambda x: x.at[(2 * x[0]).astype(int)].multiply(9 * x[1]),
    "at max by the state": lambda x: x.at[(2 * x[0]).astype(int)].max(9 * x[1]),
    "at min by the state": lambda x: x.at[(2 * x).astype(int)].min(9 * x[1]),
    "at set dropped": lambda x: x.at[(3 * x).astype(int)].set(7.0, mode="drop"),
    "at set clipped": lambda x: x.at[(3 * x[:1]).astype(int)].set(x[1:2], mode="clip"),
    "row set by the state": lambda x: jnp.outer(x, x).at[jnp.argmax(x)].set(x),
    "column added by the state": lambda x: jnp.outer(x, x).at[:, jnp.argmax(x)].add(x**3),
    "count of places": lambda x: jnp.bincount((3 * jnp.abs(x)).astype(int), length=4) * x[0],
    "roll by the state": lambda x: jnp.roll(x, jnp.argmax(x)),
    "dynamic_update_slice": lambda x: lax.dynamic_update_slice(x, x[:2], (1,)),
    "dynamic index in dim": lambda x: lax.dynamic_index_in_dim(x, 1, keepdims=False) * x,
    "index table": lambda x: x[jnp.array([0, 1, 2])[jnp.array([2, 1, 0])]],
    "roll": lambda x: jnp.roll(x, 1),
    "stack": lambda x: jnp.stack([x, 2 * x], 1),
    "tile": lambda x: jnp.tile(x, 2),
    "repeat": lambda x: jnp.repeat(x, 2),
    "diag": jnp.diag,
    "diagonal": lambda x: jnp.diagonal(A * x),
    "pad": lambda x: jnp.pad(x, (1, 2), constant_values=3.0),
    "pad by the edge": lambda x: jnp.pad(x, 1, mode="edge"),
    "negative pad": lambda x: lax.pad(x, 0.0, [(-1, 1, 0)]),
    "inner pad": lambda x: lax.pad(x, 0.0, [(0, 0, 1)]),
    "reshape": lambda x: (A * x).T.reshape(9),
    "split": lambda x: jnp.concatenate(jnp.split(x, 3)[::-1]),
    "flip": lambda x: jnp.flip(A * x, 0),
    "swapaxes": lambda x: jnp.swapaxes(A * x, 0, 1),
    "squeeze": lambda x: jnp.squeeze(x[None, :, None]),
    "append": lambda x: jnp.append(x, x[0]),
    "eye": lambda x: jnp.eye(3) * x,
    "zeros_like": lambda x: jnp.zeros_like(x).at[0].set(x[0]),
    "ravel a dict": lambda x: jax.flatten_util.ravel_pytree({"a": x[0], "b": x[1:]})[0],
    "optimization_barrier": lambda x: sum(lax.optimization_barrier((x, 2 * x, x**2))),
    "stop_gradient": lambda x: lax.stop_gradient(x) * x,
}


def knots(count):
    """A table that rises, with a knot at 0 and at 1; and values."""
    random = np.random.default_rng(count)
    t = np.sort(random.uniform(-2.0, 2.0, count))
    t[count // 3], t[count // 3 + 1 :] = 0.0, np.sort(random.uniform(0.1, 2.0, count - count // 3 - 1))
    t[2 * count // 3] = 1.0
    return np.sort(t), random.normal(size=count)


KNOTS = {count: knots(count) for count in (5, 50, 500)}
LEVELS = np.array([-0.5, -0.5, 0.0, 0.0, 1.0, 1.0, 1.0, np.inf])
MAP = np.random.default_rng(7).normal(size=(12, 9))


def bilinear(x):
    """A map of two variables, between its nodes."""
    u, v = 3.0 + 2.0 * x[0], 4.0 - 2.0 * x[1]
    i, j = jnp.floor(u).astype(int), jnp.floor(v).astype(int)
    a, b, z = u - i, v - j, jnp.asarray(MAP)
    return (1 - b) * (z[i, j] * (1 - a) + z[i + 1, j] * a) + b * (z[i, j + 1] * (1 - a) + z[i + 1, j + 1] * a)


TABLES: dict[str, Function] = {
    **{f"interp of {n}": partial(lambda t, y, x: jnp.interp(x, t, y), *KNOTS[n]) for n in KNOTS},
    **{
        f"searchsorted {side} of {n}": partial(
            lambda t, side, x: jnp.searchsorted(t, x, side=side) * x, KNOTS[n][0], side
        )
        for n in KNOTS
        for side in ("left", "right")
    },
    "interp with ends": lambda x: jnp.interp(3 * x, TABLE_T, TABLE_Y, left=-7.0, right=9.0),
    "interp extrapolated": lambda x: jnp.interp(4 * x, TABLE_T, TABLE_Y, left="extrapolate", right="extrapolate"),
    "interp of a period": lambda x: jnp.interp(9 * x, TABLE_T, TABLE_Y, period=1.5),
    "interp of NaN": lambda x: jnp.interp(jnp.where(x > 0.5, x, jnp.nan), TABLE_T, TABLE_Y),
    "interp of one entry": lambda x: jnp.interp(x, TABLE_T[:1], TABLE_Y[:1]) * x,
    "interp of states": lambda x: jnp.interp(x[0], np.array([-1.0, 0.5, 1.0]), x * x),
    "interp between states": lambda x: jnp.interp(x, jnp.cumsum(jnp.abs(x) + 0.1), x * x),
    "searchsorted among equals": lambda x: sum(
        weight * jnp.searchsorted(LEVELS, x, side=side) + x for weight, side in ((2.0, "left"), (5.0, "right"))
    ),
    "searchsorted of NaN": lambda x: jnp.searchsorted(LEVELS, jnp.where(x > 0.5, x, jnp.nan), side="right") * x,
    "searchsorted for infinity": lambda x: jnp.searchsorted(LEVELS, jnp.where(x > 0.5, x, jnp.inf), side="right") * x,
    "searchsorted among states": lambda x: jnp.searchsorted(x, x[::-1]) * x,
    "searchsorted unrolled": lambda x: jnp.searchsorted(TABLE_T, x, method="scan_unrolled") * x,
    "searchsorted by sorting": lambda x: jnp.searchsorted(TABLE_T, x, method="sort") * x,
    "searchsorted by comparing": lambda x: jnp.searchsorted(TABLE_T, x, method="compare_all") * x,
    "digitize": lambda x: jnp.digitize(x, TABLE_T) * x,
    "step table": lambda x: jnp.asarray(TABLE_Y)[jnp.floor(x).astype(int)] * x,
    "step table of 32 bits": lambda x: jnp.asarray(TABLE_Y)[jnp.floor(3 * x).astype(jnp.int32)] * x,
    "step table of 8 bits": lambda x: jnp.asarray(TABLE_Y)[(400 * x).astype(jnp.int8)] * x,
    "step table without sign": lambda x: jnp.asarray(TABLE_Y)[(3 * x).astype(jnp.uint32)] * x,
    "table of integers": lambda x: jnp.asarray([3, 1, 2, 7, 9, 11])[(3 * x).astype(int)] * x,
    "table of booleans": lambda x: jnp.where(jnp.asarray(TABLE_Y > 0)[(3 * x).astype(int)], x, -x),
    "table with infinity": lambda x: jnp.exp(-jnp.asarray([0.5, 1.0, np.inf])[(3 * x).astype(int)]) * x,
    "map": bilinear,
    "map_coordinates of two": lambda x: jax.scipy.ndimage.map_coordinates(
        jnp.asarray(MAP), [3 * x, 2 * x[::-1]], order=1, mode="nearest"
    ),
    "histogram": lambda x: jnp.histogram(x, bins=np.array([-1.0, 0.0, 0.5, 1.5]))[0] * x,
    "too many integers": lambda x: ((3 * x).astype(jnp.uint32) - 1) * x,
    "too large a table": lambda x: jnp.interp(x, np.arange(200_000.0), np.arange(200_000.0)),
    "too many states": lambda x: jnp.interp(x, jnp.arange(70.0) * (1 + x[0] ** 2), np.arange(70.0)),
}


def matrix(size):
    """A matrix (size, size) with small entries on its diagonal, so that rows have to be exchanged."""
    first, second, third = np.random.default_rng(size).normal(size=(3, size, size))
    np.fill_diagonal(first, 0.01)
    return lambda x: first + x[0] * second + jnp.sin(x[1]) * x[2] * third


def positive(size):
    return lambda x: matrix(size)(x) @ matrix(size)(x).T + jnp.eye(size)


def right(size):
    return np.random.default_rng(size + 100).normal(size=size)


def banded(x):
    """A matrix of which the structure says where pivots are."""
    return jnp.array([[0.0, x[0], 0.0], [2.0, 0.0, 0.0], [0.0, x[1], 1.0 + x[2] ** 2]])


MATRICES: dict[str, Function] = {
    **{f"solve {n}": lambda x, n=n: jnp.linalg.solve(matrix(n)(x), right(n) * x[1]) for n in range(1, 7)},
    **{f"inv {n}": lambda x, n=n: jnp.linalg.inv(matrix(n)(x)) for n in range(1, 6)},
    **{f"det {n}": lambda x, n=n: jnp.linalg.det(matrix(n)(x)) * x for n in range(1, 7)},
    **{f"slogdet {n}": lambda x, n=n: jnp.stack(jnp.linalg.slogdet(matrix(n)(x))) for n in range(1, 7)},
    **{f"cholesky {n}": lambda x, n=n: jnp.linalg.cholesky(positive(n)(x)) for n in (1, 2, 3, 4, 5)},
    **{
        f"positive definite system {n}": lambda x, n=n: jax.scipy.linalg.solve(
            positive(n)(x), right(n) * x[0], assume_a="pos"
        )
        for n in (1, 2, 4, 5, 6)
    },
    "cholesky 7": lambda x: jnp.linalg.cholesky(positive(7)(x))[-1],
    "upper cholesky": lambda x: jax.scipy.linalg.cholesky(positive(3)(x)),
    "cholesky of an indefinite matrix": lambda x: jnp.linalg.cholesky(matrix(3)(x)),
    "cho_solve": lambda x: jax.scipy.linalg.cho_solve((jnp.diag(x + 2.0) + A, True), x),
    "solve of a singular matrix": lambda x: jnp.linalg.solve(
        jnp.array([[1.0, 2.0], [2.0, 4.0]]) * (1.0 + jnp.floor(jnp.abs(x[0]))), x[:2]
    ),
    "solve of several": lambda x: jnp.linalg.solve(matrix(3)(x), A * x),
    "solve of a batch": lambda x: jnp.linalg.solve(jnp.stack([matrix(3)(x), matrix(3)(2 * x)]), (A * x)[:2, :, None]),
    "solve in vmap": lambda x: jax.vmap(lambda s: jnp.linalg.solve(matrix(3)(s * x), x))(np.array([1.0, 2.0])),
    "solve with structure": lambda x: jnp.linalg.solve(banded(x + 2.0), x),
    "solve with a known matrix of 10": lambda x: jnp.linalg.solve(matrix(10)(np.ones(3)), right(10) * x[0]),
    "solve_triangular": lambda x: jax.scipy.linalg.solve_triangular(matrix(4)(x) + jnp.eye(4), right(4) * x[0]),
    "solve_triangular, lower": lambda x: jax.scipy.linalg.solve_triangular(A * x, x, lower=True, trans=1),
    "solve_triangular, unit diagonal": lambda x: jax.scipy.linalg.solve_triangular(A * x, x, unit_diagonal=True),
    "triangular_solve from the right": lambda x: lax.linalg.triangular_solve(A * x, A, left_side=False, lower=True),
    "lu_factor": lambda x: jax.scipy.linalg.lu_factor(matrix(3)(x))[0],
    "lu": lambda x: jnp.stack(jax.scipy.linalg.lu(matrix(3)(x))),
    "lu of zeros": lambda x: lax.linalg.lu(matrix(3)(x) * jnp.array([0.0, 1.0, 1.0]))[0],
}

random_values = np.random.default_rng(5).normal(size=(16, 3))


def some(count):
    """As many numbers, with equal ones among them where the state has such."""
    return lambda x: jnp.concatenate([x, random_values @ x])[:count]


ORDER: dict[str, Function] = {
    **{f"sort {n}": lambda x, n=n: jnp.sort(some(n)(x)) for n in (2, 5, 8, 16, 17)},
    **{f"argsort {n}": lambda x, n=n: some(n)(x)[jnp.argsort(some(n)(x))] * jnp.argsort(-some(n)(x)) for n in (2, 8)},
    "sort descending": lambda x: jnp.sort(x, descending=True),
    "sort with NaN": lambda x: jnp.sort(jnp.where(x > 0.5, x, jnp.nan)),
    "sort of rows": lambda x: jnp.sort(jnp.outer(x, np.array([1.0, -1.0, 2.0])), axis=0),
    "sort of integers": lambda x: jnp.sort((3 * x).astype(int)) * x,
    "sort of booleans": lambda x: jnp.sort(x > 0.5) * x,
    "sort of pairs": lambda x: lax.sort((jnp.floor(2 * x), x * np.arange(3.0)))[1],
    "lexsort": lambda x: x[jnp.lexsort((x, jnp.floor(x)))],
    "sort by two keys": lambda x: lax.sort((jnp.floor(x), -x, x * np.arange(3.0)), num_keys=2)[2],
    "median 5": lambda x: jnp.median(some(5)(x)),
    "percentile": lambda x: jnp.percentile(some(6)(x), 40.0),
    "quantile by the state": lambda x: jnp.quantile(some(6)(x), jax.nn.sigmoid(x[0])),
    "nanmedian": lambda x: jnp.nanmedian(jnp.where(x > 0.5, x, jnp.nan)),
    "top_k 4": lambda x: lax.top_k(some(6)(x), 4)[0] * lax.top_k(some(6)(x), 4)[1],
    "top_k with NaN": lambda x: lax.top_k(jnp.where(x > 0.5, x, jnp.nan), 2)[0],
    "argpartition": lambda x: x[jnp.argpartition(x, 1)],
    "largest by its place": lambda x: x[jnp.argmax(x)],
    "entry of a matrix by places": lambda x: jnp.outer(x, x)[jnp.argmin(x), jnp.argmax(-x)] * x,
}

LOOPS: dict[str, Function] = {
    "fori_loop": lambda x: lax.fori_loop(0, 3, lambda i, y: y * x + i, x),
    "newton": newton,
    "taylor": taylor,
    "scan": lambda x: lax.scan(lambda c, a: (c + a, c * a), x[0], x)[1],
    "scan reversed": lambda x: lax.scan(lambda c, a: (c + a, c * a), x[0], x, reverse=True)[1],
    "scan of nothing": lambda x: lax.scan(lambda c, a: (c * a, c), x, x[:0])[0],
    "scan of length 0": lambda x: lax.scan(lambda c, _: (c * 2, c), x, None, length=0)[0],
    "columns of a scan of nothing": lambda x: jnp.sum(lax.scan(lambda c, a: (c * a, c), x, x[:0])[1]) + x,
    "scan of booleans": lambda x: lax.scan(lambda c, a: (c | (a > 1), c), x[0] > 0.5, x)[1] * x,
    "scan with a counter": lambda x: lax.scan(lambda c, a: ((c[0] + 1, c[1] * a + c[0]), c[1]), (0, x[0]), x)[1],
    "associative_scan": lambda x: lax.associative_scan(jnp.multiply, x),
    "map": lambda x: lax.map(lambda a: jnp.sin(a) * a, x),
    "vmap": lambda x: jax.vmap(lambda row: row @ x)(A),
    "vmap of an index": lambda x: jax.vmap(lambda k: x[k])(jnp.array([2, 1, 0])),
    "known while": lambda x: lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, c[1] * x), (0, x))[1],
    "while": lambda x: lax.while_loop(lambda y: y[0] < 9.0, lambda y: 2 * y + 1, x),
    "fori_loop as long as the state says": lambda x: lax.fori_loop(0, jnp.sum(x > 0.5), lambda i, y: 2 * y, x),
    "long": lambda x: lax.fori_loop(0, 30_000, lambda i, y: y * x, x),
    "jit inside": lambda x: inner(x),
    "jit with a static argument": lambda x: powered(x, 3),
    "checkpoint": remade,
    "custom_jvp": friction,
    "custom_vjp": saturated,
    "gradient inside": lambda x: jax.grad(lambda y: jnp.sum(y**3))(x),
    "jacobian inside": lambda x: jax.jacfwd(lambda y: y**2)(x),
    "jvp inside": lambda x: jax.jvp(jnp.sin, (x,), (x,))[1],
    "linearize": lambda x: jax.linearize(jnp.sin, x)[1](x),
    "fori_loop with an index": lambda x: lax.fori_loop(0, 4, lambda i, y: y + x[(i + jnp.argmax(x)) % 3], 0.0) * x,
    "custom_root": lambda x: lax.custom_root(
        lambda y: y**3 + y - x, x, lambda f, y: newton(x), lambda g, y: y / g(jnp.ones(3))
    ),
    "debug print": lambda x: (jax.debug.print("{}", x[0]), x)[1],
    "callback": lambda x: jax.pure_callback(np.sin, jax.ShapeDtypeStruct((3,), np.float64), x),
    "random": lambda x: x + jax.random.normal(jax.random.key(0), (3,)),
    "random by the state": lambda x: x * jax.random.normal(jax.random.key(jnp.sum(x > 0.5)), (3,)),
    "single precision": lambda x: x.astype(jnp.float32).astype(float) * x,
    "single precision constant": lambda x: x * jnp.asarray(np.float32(0.1)),
}

SPECIAL: dict[str, Function] = {
    **{
        f"nn.{name}": getattr(nn, name)
        for name in (
            *("relu", "relu6", "sigmoid", "softplus", "soft_sign", "silu", "log_sigmoid", "leaky_relu", "hard_sigmoid"),
            *("hard_silu", "hard_tanh", "elu", "celu", "selu", "gelu", "squareplus", "mish", "softmax", "log_softmax"),
            *("standardize", "logsumexp"),
        )
    },
    "nn.glu": lambda x: nn.glu(jnp.concatenate([x, x[:1]])),
    "nn.one_hot": lambda x: nn.one_hot(1, 3) * x,
    "nn.one_hot by the state": lambda x: nn.one_hot(jnp.argmax(x), 3) * x,
    "nn.gelu exact": lambda x: nn.gelu(x, approximate=False),
    "erf": special.erf,
    "erfc": special.erfc,
    "erfinv": lambda x: special.erfinv(0.5 * jnp.tanh(x)),
    "ndtr": special.ndtr,
    "log_ndtr": special.log_ndtr,
    "ndtri": lambda x: special.ndtri(special.expit(x)),
    "expit": special.expit,
    "logit": lambda x: special.logit(special.expit(x) * 0.9),
    "xlogy": lambda x: special.xlogy(x, x + 2.0),
    "xlog1py": lambda x: special.xlog1py(x, x),
    "entr": special.entr,
    "rel_entr": lambda x: special.rel_entr(x, x[::-1]),
    "logsumexp": lambda x: special.logsumexp(x) * x,
    "gammaln": special.gammaln,
    "gamma": special.gamma,
    "digamma": special.digamma,
    "betaln": lambda x: special.betaln(jnp.abs(x) + 1, 2.0),
    "beta": lambda x: special.beta(jnp.abs(x) + 1, 2.0),
    "factorial": lambda x: special.factorial(jnp.abs(x)),
    "gammainc": lambda x: special.gammainc(2.0, jnp.abs(x)),
    "betainc": lambda x: special.betainc(2.0, 3.0, nn.sigmoid(x)),
    "i0e": special.i0e,
    "i1": special.i1,
    "bessel_jn": lambda x: special.bessel_jn(x, v=2)[0],
    "spence": lambda x: special.spence(jnp.abs(x)),
    "zeta": lambda x: special.zeta(2.0 + jnp.abs(x), 1.0),
    "expi": lambda x: special.expi(x),
    "exp1": lambda x: special.exp1(jnp.abs(x)),
    "hyp1f1": lambda x: special.hyp1f1(1.0, 2.0, x),
    "poch": lambda x: special.poch(jnp.abs(x) + 1, 2.0),
    "kl_div": lambda x: special.kl_div(x, x[::-1]),
    "norm.cdf": jax.scipy.stats.norm.cdf,
    "norm.logpdf": jax.scipy.stats.norm.logpdf,
}

FUNCTIONS: dict[str, Function] = {
    f"{group}: {name}": function
    for group, members in (
        ("arithmetic", ARITHMETIC),
        ("elementary", ELEMENTARY),
        ("rounding", ROUNDING),
        ("decisions", DECISIONS),
        ("arrays", ARRAYS),
        ("places", PLACES),
        ("tables", TABLES),
        ("matrices", MATRICES),
        ("order", ORDER),
        ("loops", LOOPS),
        ("special", SPECIAL),
    )
    for name, function in members.items()
}
"""All functions by name."""

FALLS_BACK = {
    "elementary: i0": "calls jnp.i0",
    "rounding: copysign": "calls jnp.copysign",
    "rounding: signbit": "calls jnp.signbit",
    "decisions: mean of booleans": "converts what depends on the state to float32",
    "decisions: bits": "does integer arithmetic (and) with what depends on the state",
    "decisions: shift": "does integer arithmetic (shift_left) with what depends on the state",
    "arrays: eigh": "calls jnp.linalg.eigh",
    "arrays: svd": "calls jnp.linalg.svd",
    "arrays: qr": "calls jnp.linalg.qr",
    "arrays: expm": "calls jax.scipy.linalg.expm, which takes more than 10000 operations",
    "arrays: cumlogsumexp": "calls jax.lax.cumlogsumexp",
    "arrays: convolve": "calls jnp.convolve",
    "arrays: correlate": "calls jnp.correlate",
    "arrays: fft": "calls jnp.fft, which converts what depends on the state to complex128",
    "arrays: complex": "converts what depends on the state to complex128",
    "tables: too large a table": "calls jnp.interp, which searches a table of 200000 entries (limit: 100000)",
    "tables: too many states": "calls jnp.interp, which searches 70 numbers that depend on the state (limit: 64)",
    "matrices: solve 6": "calls jnp.linalg.solve, which works with a matrix of 6 rows (limit: 5)",
    "matrices: det 6": "calls jnp.linalg.det, which works with a matrix of 6 rows (limit: 5)",
    "matrices: slogdet 6": "calls jnp.linalg.slogdet, which works with a matrix of 6 rows (limit: 5)",
    "matrices: cholesky 7": "calls jnp.linalg.cholesky, which works with a matrix of 7 rows (limit: 6)",
    "matrices: positive definite system 6": "takes more than 10000 operations",
    "order: sort 17": "calls jnp.sort, which sorts 17 numbers that depend on the state (limit: 16)",
    "loops: known while": "cannot be traced with its derivatives: ValueError",
    "loops: while": "cannot be traced with its derivatives: ValueError",
    "loops: fori_loop as long as the state says": "cannot be traced with its derivatives: ValueError",
    "loops: long": "takes more than 10000 operations",
    "loops: custom_vjp": "cannot be traced with its derivatives: TypeError",
    "loops: debug print": "calls jax.lax.debug_print",
    "loops: callback": "cannot be traced with its derivatives: ValueError",
    "loops: random by the state": "does integer arithmetic (random_seed) with what depends on the state",
    "loops: single precision": "converts what depends on the state to float32",
    "special: erfinv": "calls jax.lax.erf_inv",
    "special: gammaln": "calls jax.lax.lgamma",
    "special: gamma": "calls jax.scipy.special.gammasgn",
    "special: digamma": "calls jax.lax.digamma",
    "special: betaln": "calls jax.lax.lgamma",
    "special: beta": "calls jax.scipy.special.gammasgn",
    "special: factorial": "calls jax.lax.lgamma",
    "special: gammainc": "calls jax.lax.igamma",
    "special: betainc": "calls jax.lax.regularized_incomplete_beta",
    "special: i0e": "calls jax.lax.bessel_i0e",
    "special: i1": "calls jax.lax.bessel_i1e",
    "special: zeta": "calls jax.lax.zeta",
    "special: expi": "calls jax.scipy.special.expi",
    "special: exp1": "calls jax.scipy.special.expn",
    "special: hyp1f1": "calls jax.scipy.special.hyp1f1",
    "special: poch": "calls jax.scipy.special.gammasgn",
}
"""Functions that JAX has to evaluate, and why."""

LEFT_AT_SOME_POINTS = ("decisions: large integers", "tables: too many integers")
"""Functions with integers that leave their type: JAX evaluates the points where they do."""

ZERO_TIMES_INFINITY = (
    "arithmetic: divide",
    "arithmetic: divide by itself",
    "arithmetic: overflow",
    "arithmetic: power of a negative",
    "arrays: vander",
    "elementary: arccos",
    "elementary: arccosh",
    "elementary: arcsin",
    "elementary: arctan2",
    "elementary: arctanh",
    "elementary: cbrt",
    "elementary: log",
    "elementary: log10",
    "elementary: log2",
    "elementary: nan_to_num",
    "elementary: rsqrt",
    "elementary: sqrt",
    "elementary: unguarded sqrt",
    "matrices: solve of a singular matrix",
    "matrices: solve_triangular, lower",
    "matrices: triangular_solve from the right",
    "special: bessel_jn",
)
"""Functions of which JAX says NaN for an entry of a derivative that is 0: a tangent of 0 times an infinite slope."""
