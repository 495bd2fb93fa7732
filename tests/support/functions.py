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


@jax.checkpoint
def remade(x):
    return jnp.exp(jnp.sin(x))


ARITHMETIC: dict[str, Function] = {
    "divide by itself": lambda x: x / (x[0] - x[0]),
    "power 0": lambda x: x**0 + x,
    "power of a negative": lambda x: x ** x[1],
    "mod": lambda x: x % 0.4,
    "remainder": lambda x: jnp.remainder(x, x[::-1] + 2.0),
    "overflow": lambda x: jnp.exp(800 * x),
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
    "angle": lambda x: jnp.unwrap(2 * x),
    "guarded log": lambda x: jnp.where(x > 0, jnp.log(jnp.where(x > 0, x, 1.0)), 0.0),
    "unguarded sqrt": lambda x: jnp.where(x > 0, jnp.sqrt(x), 0.0),
    "i0": lambda x: jnp.i0(x),
}

ROUNDING: dict[str, Function] = {
    "round": lambda x: jnp.round(3 * x) * x,
    "round away": lambda x: lax.round(
        x + np.array([0.5, 0.49999999999999994, -0.5]), lax.RoundingMethod.AWAY_FROM_ZERO
    ),
    "sign of zero": lambda x: jnp.sign(x * 0.0) + x,
    "copysign": lambda x: jnp.copysign(x, x[::-1]),
}

DECISIONS: dict[str, Function] = {
    "where of booleans": lambda x: jnp.where(jnp.where(x > 0.7, x > 1, x < 0.3), x, 2 * x),
    "booleans less or equal": lambda x: jnp.where((x > 0.7) <= (x < 1), x, -x),
    "booleans greater": lambda x: jnp.where((x > 0.7) > (x < 1), x, -x),
    "max of booleans": lambda x: jnp.where(jnp.maximum(x > 0.7, x < 0.3), x, -x),
    "least boolean": lambda x: jnp.where(jnp.min(x > 0.1), x, -x),
    "xor": lambda x: jnp.where((x > 0.7) ^ (x < 1), x, -x),
    "all": lambda x: jnp.all(x > 0.1) * x,
    "count": lambda x: jnp.sum(x > 0.5) * x,
    "mean of booleans": lambda x: jnp.mean(x > 0.5) * x,
    "product of booleans": lambda x: jnp.prod(x > 0.5) * x,
    "plus or minus one": lambda x: jnp.where(x > 0.7, 1, -1) * x,
    "integer division": lambda x: (jnp.where(x > 0.7, 7, 5) // 2) * x,
    "bits": lambda x: (jnp.where(x > 0.7, 7, 5) & 6) * x,
    "large integers": lambda x: jnp.where(x > 0.7, 2**31, 5) * (jnp.where(x > 0.1, 2**33, 1)) * x,
    "clamp by states": lambda x: lax.clamp(0.5 * x, x**2, 1.5 * x),
    "select": lambda x: jnp.select([x < 0.5, x < 1.0], [x, x**2], jnp.cos(x)),
    "select_n": lambda x: lax.select_n((x > 0.5).astype(jnp.int32) + (x > 1), x, x**2, x**3),
    "isfinite": lambda x: jnp.where(jnp.isfinite(1 / x), x, 0.0),
    "cond of several": lambda x: sum(lax.cond(x[0] > 0.8, lambda v: (v, v**2), lambda v: (v**3, 1.0 * v), x)),
    "division of integers by zero": lambda x: lax.div((30 * x).astype(int), (3 * x).astype(int)) * x,
    "integers have no negative zero": lambda x: jnp.arctan2(((0.4 * x).astype(int) * -3).astype(float), -1.0) * x,
    "integers of NaN": lambda x: jnp.where(x > 0.5, x, jnp.nan).astype(int) * x,
    "hysteresis": lambda x: lax.scan(lambda s, v: ((s & (v > 0.3)) | (v > 0.9),) * 2, x[0] > 0.5, x)[1] * x,
}

ARRAYS: dict[str, Function] = {
    "einsum of a batch": lambda x: jnp.einsum("bi,bj->bij", A * x, A),
    "solve": lambda x: jnp.linalg.solve(A + jnp.outer(x, x), x),
    "eigh": lambda x: jnp.linalg.eigh(A + jnp.outer(x, x))[0],
    "expm": lambda x: jax.scipy.linalg.expm(0.1 * A * x),
    "sum of nothing": lambda x: jnp.sum(x[:0]) + x,
    "matrix of nothing": lambda x: jnp.zeros((3, 0)) @ x[:0] + x,
    "max of nothing": lambda x: jnp.maximum(jnp.max(x[:0], initial=-1.0), x),
    "any of nothing": lambda x: jnp.where(jnp.any(x[:0] > 1), x, -x),
    "cumprod": jnp.cumprod,
    "cummax": lambda x: lax.cummax(x),
    "cummin": lambda x: lax.cummin(x),
    "cumlogsumexp": lambda x: lax.cumlogsumexp(x),
    "convolve": lambda x: jnp.convolve(x, np.array([0.2, 0.5, 0.3]), mode="same"),
    "searchsorted": lambda x: jnp.searchsorted(TABLE_T, x) * x,
    "interp": lambda x: jnp.interp(x, TABLE_T, TABLE_Y),
    "interp by hand": lambda x: sum(
        jnp.where((x >= a) & (x < b), p + (q - p) * (x - a) / (b - a), 0.0)
        for a, b, p, q in zip(TABLE_T[:-1], TABLE_T[1:], TABLE_Y[:-1], TABLE_Y[1:], strict=True)
    ),
    "fft": lambda x: jnp.abs(jnp.fft.fft(x)),
}

PLACES: dict[str, Function] = {
    "at add twice": lambda x: x.at[jnp.array([2, 0, 2])].add(x),
    "at multiply": lambda x: x.at[1].multiply(x[0]),
    "at max": lambda x: x.at[1].max(0.7),
    "index out of range": lambda x: x[jnp.array([0, 7])],
    "dynamic_slice of a matrix by the state": lambda x: lax.dynamic_slice(
        jnp.outer(x, x), (jnp.argmax(x), jnp.argmin(x)), (2, 1)
    ),
    "dynamic_update_slice by the state": lambda x: lax.dynamic_update_slice(
        jnp.outer(x, x), 3 * jnp.outer(x, x)[:2, :2], (jnp.argmax(x), jnp.sum(x > 1))
    ),
    "take wrapped": lambda x: jnp.take(x, (3 * x).astype(int), mode="wrap"),
    "at get with NaN by the state": lambda x: x.at[(3 * x).astype(int)].get(mode="fill"),
    "at set by the state": lambda x: x.at[(3 * x[0]).astype(int)].set(9 * x[1]),
    "at min by the state": lambda x: x.at[(2 * x).astype(int)].min(9 * x[1]),
    "at set dropped": lambda x: x.at[(3 * x).astype(int)].set(7.0, mode="drop"),
    "at set clipped": lambda x: x.at[(3 * x[:1]).astype(int)].set(x[1:2], mode="clip"),
    "tile": lambda x: jnp.tile(x, 2),
    "negative pad": lambda x: lax.pad(x, 0.0, [(-1, 1, 0)]),
    "split": lambda x: jnp.concatenate(jnp.split(x, 3)[::-1]),
    "optimization_barrier": lambda x: sum(lax.optimization_barrier((x, 2 * x, x**2))),
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
    "interp of NaN": lambda x: jnp.interp(jnp.where(x > 0.5, x, jnp.nan), TABLE_T, TABLE_Y),
    "interp of states": lambda x: jnp.interp(x[0], np.array([-1.0, 0.5, 1.0]), x * x),
    "searchsorted of NaN": lambda x: jnp.searchsorted(LEVELS, jnp.where(x > 0.5, x, jnp.nan), side="right") * x,
    "searchsorted by comparing": lambda x: jnp.searchsorted(TABLE_T, x, method="compare_all") * x,
    "step table of 8 bits": lambda x: jnp.asarray(TABLE_Y)[(400 * x).astype(jnp.int8)] * x,
    "map": bilinear,
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
    "solve with structure": lambda x: jnp.linalg.solve(banded(x + 2.0), x),
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
    "cholesky of an indefinite matrix": lambda x: jnp.linalg.cholesky(matrix(3)(x)),
    "solve of a singular matrix": lambda x: jnp.linalg.solve(
        jnp.array([[1.0, 2.0], [2.0, 4.0]]) * (1.0 + jnp.floor(jnp.abs(x[0]))), x[:2]
    ),
    "solve of a batch": lambda x: jnp.linalg.solve(jnp.stack([matrix(3)(x), matrix(3)(2 * x)]), (A * x)[:2, :, None]),
    "lu": lambda x: jnp.stack(jax.scipy.linalg.lu(matrix(3)(x))),
}

random_values = np.random.default_rng(5).normal(size=(16, 3))


def some(count):
    """As many numbers, with equal ones among them where the state has such."""
    return lambda x: jnp.concatenate([x, random_values @ x])[:count]


ORDER: dict[str, Function] = {
    **{f"sort {n}": lambda x, n=n: jnp.sort(some(n)(x)) for n in (2, 5, 8, 16, 17)},
    **{f"argsort {n}": lambda x, n=n: some(n)(x)[jnp.argsort(some(n)(x))] * jnp.argsort(-some(n)(x)) for n in (2, 8)},
    "sort with NaN": lambda x: jnp.sort(jnp.where(x > 0.5, x, jnp.nan)),
    "sort of pairs": lambda x: lax.sort((jnp.floor(2 * x), x * np.arange(3.0)))[1],
    "quantile by the state": lambda x: jnp.quantile(some(6)(x), jax.nn.sigmoid(x[0])),
    "nanmedian": lambda x: jnp.nanmedian(jnp.where(x > 0.5, x, jnp.nan)),
    "top_k 4": lambda x: lax.top_k(some(6)(x), 4)[0] * lax.top_k(some(6)(x), 4)[1],
}

LOOPS: dict[str, Function] = {
    "scan of nothing": lambda x: lax.scan(lambda c, a: (c * a, c), x, x[:0])[0],
    "scan of length 0": lambda x: lax.scan(lambda c, _: (c * 2, c), x, None, length=0)[0],
    "while": lambda x: lax.while_loop(lambda y: y[0] < 9.0, lambda y: 2 * y + 1, x),
    "checkpoint": remade,
    "custom_jvp": friction,
    "custom_vjp": saturated,
    "debug print": lambda x: (jax.debug.print("{}", x[0]), x)[1],
    "callback": lambda x: jax.pure_callback(np.sin, jax.ShapeDtypeStruct((3,), np.float64), x),
    "random by the state": lambda x: x * jax.random.normal(jax.random.key(jnp.sum(x > 0.5)), (3,)),
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
    "erfinv": lambda x: special.erfinv(0.5 * jnp.tanh(x)),
    "ndtr": special.ndtr,
    "betainc": lambda x: special.betainc(2.0, 3.0, nn.sigmoid(x)),
    "bessel_jn": lambda x: special.bessel_jn(x, v=2)[0],
    "expi": lambda x: special.expi(x),
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
    "decisions: mean of booleans": "converts what depends on the state to float32",
    "decisions: bits": "does integer arithmetic (and) with what depends on the state",
    "arrays: eigh": "calls jnp.linalg.eigh",
    "arrays: expm": "calls jax.scipy.linalg.expm, which takes more than 10000 operations",
    "arrays: cumlogsumexp": "calls jax.lax.cumlogsumexp",
    "arrays: convolve": "calls jnp.convolve",
    "arrays: fft": "calls jnp.fft, which converts what depends on the state to complex128",
    "tables: too large a table": "calls jnp.interp, which searches a table of 200000 entries (limit: 100000)",
    "tables: too many states": "calls jnp.interp, which takes one of 70 numbers by an index that depends on the state "
    "(limit: 64)",
    "matrices: solve 6": "calls jnp.linalg.solve, which works with a matrix of 6 rows (limit: 5)",
    "matrices: det 6": "calls jnp.linalg.det, which works with a matrix of 6 rows (limit: 5)",
    "matrices: slogdet 6": "calls jnp.linalg.slogdet, which works with a matrix of 6 rows (limit: 5)",
    "matrices: cholesky 7": "calls jnp.linalg.cholesky, which works with a matrix of 7 rows (limit: 6)",
    "matrices: positive definite system 6": "takes more than 10000 operations",
    "order: sort 17": "calls jnp.sort, which sorts 17 numbers that depend on the state (limit: 16)",
    "order: top_k 4": "calls jax.lax.top_k",
    "loops: while": "cannot be traced with its derivatives: ValueError",
    "loops: custom_vjp": "cannot be traced with its derivatives: TypeError",
    "loops: debug print": "calls jax.lax.debug_print",
    "loops: callback": "cannot be traced with its derivatives: ValueError",
    "loops: random by the state": "does integer arithmetic (random_seed) with what depends on the state",
    "special: erfinv": "calls jax.lax.erf_inv",
    "special: betainc": "calls jax.lax.regularized_incomplete_beta",
    "special: expi": "calls jax.scipy.special.expi",
}
"""Functions that JAX has to evaluate, and why."""

LEFT_AT_SOME_POINTS = ("decisions: large integers", "tables: too many integers")
"""Functions with integers that leave their type: JAX evaluates the points where they do."""

INVERSES = "arccos arccosh arcsin arctan2 arctanh cbrt log log10 log2 sqrt"
ZERO_TIMES_INFINITY = [
    *(f"arithmetic: {name}" for name in ("divide by itself", "overflow", "power of a negative")),
    *(f"elementary: {name}" for name in (*INVERSES.split(), "unguarded sqrt")),
    "matrices: solve of a singular matrix",
    "special: bessel_jn",
]
"""Functions of which JAX says NaN for an entry of a derivative that is 0: a tangent of 0 times an infinite slope."""
