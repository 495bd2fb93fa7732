"""One row: the coefficients of its method, its stages, its derivatives along one direction, its adjoint, and its size.

With the stages ``X_j = x + h sum_l a_jl K_l``, ``K_j = f(t_j, X_j, p)`` at ``t_j = start + c_j h`` a row maps x to
``x+ = x + h sum_j b_j K_j`` and costs ``L = h sum_j b_j ell(t_j, X_j, p)``. Machine code is made of the equations
below; JAX differentiates the stages by itself.

tangent    along a direction in which x, p, start and end change by x', p', start', end', with ``h' = end' - start'``
           and ``t_j' = start' + c_j h'``,

           ``X_j' = x' + h sum_l a_jl K_l' + h' sum_l a_jl K_l``,  ``K_j' = D_1 f X_j' + D_2 f t_j' + D_p f p'``,
           ``x+' = x' + h sum_j b_j K_j' + h' sum_j b_j K_j``;

adjoint    with the derivative psi of the cost to go in x+,

           ``w_j = h b_j psi + h sum_l a_lj mu_l``,  ``mu_j = D_x (w_j . f + h b_j ell)``,
           ``psi_before = psi + sum_j mu_j``;

second     with Z_j the derivative of (t_j, X_j, p) along theta, and V that of the cost to go in h at fixed t_j,

           ``D^2 = sum_j Z_j' D^2 (w_j . f + h b_j ell) Z_j + h' x V' + V' x h'``,
           ``V = sum_j b_j (psi . K_j + ell_j) + sum_j mu_j . sum_l a_jl K_l``.

Only rows that open or close a mode have times that depend on theta. Arrays are NumPy arrays of the nodes of a graph,
whose vectors hold one entry per unknown, so that all directions are treated at once.

The slopes of an implicit method depend on each other. Newton's method finds the *increments* ``k_j = h K_j``, from
which ``X_j = x + sum_l a_jl k_l`` follows,

    ``(I - h a_jl D_1 f_j) dk = h f(t_j, X_j) - k_j``,

and with the matrix of these coupled equations also the tangents, ``(I - h a_jl D_1 f_j) K' = ...``, and, transposed,
the adjoint. A function that factorizes this matrix, or its factors, are passed: machine code eliminates entry by entry,
or calls a routine.

Step size control of the adaptive solve that chooses the mesh, in machine code.

A step of the Dormand-Prince pair (`ADAPTIVE`) from y at t, with the stages of `rows`, has the error
``e = h sum_j e_j K_j``. It is accepted if ``norm = rms(e / (atol + rtol max(|y|, |y+|))) < 1``. The next step size is
``h min(10, max(0.2, 0.9 norm^(-1/5)))``, not larger than h after a rejected step. A step after an accepted one is never
shorter than a few units in the last place of t, and the last step ends at the end time exactly. This is the step size
control of SciPy's RK45 (Hairer, Norsett and Wanner I, section II.4). Steps of the implicit method have the error of
`estimate_error`, whose order is 4: the exponent is -1/4. A step whose stages are not found has an error
that is NaN, and is rejected.

Functions of one step take `xp`, the module for their arrays: NumPy, or the namespace of a graph of scalars.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, NamedTuple, Protocol

import numpy as np

from switchfit.problem.data import FloatArray


class Tableau(NamedTuple):
    """Coefficients of a Runge-Kutta method with s stages.

    Attributes
    ----------
    a, b, c : (s, s), (s,), (s,)
    coupled : int
        Number of stages of an implicit method, whose equations are solved together; 0 for an explicit method. Stages
        behind them repeat the last of them, with weight zero: see `pad`.
    """

    a: FloatArray
    b: FloatArray
    c: FloatArray
    coupled: int = 0

    def pad(self, stages: int) -> Tableau:
        """Return the same method with that many stages: those added repeat the last one, with weight zero.

        The last one, because no other point is sure to be in the domain of the vector field.
        """
        behind = (0, stages - len(self.b))
        a = np.pad(np.pad(self.a, (behind, (0, 0)), mode="edge"), ((0, 0), behind))
        return self._replace(a=a, b=np.pad(self.b, behind), c=np.pad(self.c, behind, mode="edge"))


def butcher() -> Tableau:
    """Return the tableau of Butcher (1964), order 5 with six stages.

    All weights are positive or zero, so that the integral of a positive running cost is positive whatever the step;
    those of Dormand and Prince are not.
    """
    a = np.zeros((6, 6))
    a[1, :1] = [1 / 4]
    a[2, :2] = [1 / 8, 1 / 8]
    a[3, :3] = [0, -1 / 2, 1]
    a[4, :4] = [3 / 16, 0, 0, 9 / 16]
    a[5, :5] = [-3 / 7, 2 / 7, 12 / 7, -12 / 7, 8 / 7]
    return Tableau(a, np.array([7, 0, 32, 12, 32, 7]) / 90, a.sum(1))


def radau_iia() -> Tableau:
    """Return the tableau of Radau IIA of order 5 with three stages (Hairer and Wanner II, table IV.5.6): L-stable,
    stiffly accurate.
    """
    r = np.sqrt(6.0)
    a = np.array(
        [
            [(88 - 7 * r) / 360, (296 - 169 * r) / 1800, (-2 + 3 * r) / 225],
            [(296 + 169 * r) / 1800, (88 + 7 * r) / 360, (-2 - 3 * r) / 225],
            [(16 - r) / 36, (16 + r) / 36, 1 / 9],
        ]
    )
    # Stiffly accurate: b is the last row of a, so that x+ is the state of the last stage.
    return Tableau(a, a[2].copy(), np.array([(4 - r) / 10, (4 + r) / 10, 1.0]), coupled=3)


def dormand_prince() -> Tableau:
    """Return the tableau of Dormand and Prince (1980), order 5 (Hairer, Norsett and Wanner I, table II.5.2).

    It is that of SciPy's RK45, importing which takes longer than most fits.
    """
    a = np.zeros((6, 5))
    a[1, :1] = [1 / 5]
    a[2, :2] = [3 / 40, 9 / 40]
    a[3, :3] = [44 / 45, -56 / 15, 32 / 9]
    a[4, :4] = [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729]
    a[5, :5] = [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656]
    b = np.array([35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84])
    return Tableau(a, b, np.array([0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1]))


EXPLICIT, STIFF = butcher(), radau_iia()
# 1/9, 3/9, 5/9 at c = 0, 1/4, 3/4 satisfy the four conditions of order 3: sum b = 1, sum b c = 1/2, sum b c^2 = 1/3 and
# sum b a c = 1/6.
EXPLICIT_ERROR = EXPLICIT.b - np.array([1, 0, 3, 0, 5, 0]) / 9
"""Weights of the slopes in an estimate of the error of `EXPLICIT`: its difference to a method of order 3 with the same
stages."""
# Stages 2 and 3 are both at c = 1/4; the third, which is the more accurate, makes the five times equidistant.
EXPLICIT_BEND = np.array([1.0, 0.0, -4.0, 6.0, -4.0, 1.0])
"""Fourth difference of the slopes at the stages of `EXPLICIT`."""
ADAPTIVE = dormand_prince()
ADAPTIVE_ERROR = np.array([-71 / 57600, 0, 71 / 16695, -71 / 1920, 17253 / 339200, -22 / 525, 1 / 40])
"""Weights of the slopes of the stages, then of the slope behind the step, in the error of a step of `ADAPTIVE` of
length 1; its order is 4, its signs are those of SciPy."""


STIFF_DAMPING = 1 / (3 + 3 ** (2 / 3) - 3 ** (1 / 3))
# Weights of Z_j = X_j - x in the book; Z = a k turns them into weights of the increments.
STIFF_ERROR = np.array([-13 - 7 * np.sqrt(6.0), -13 + 7 * np.sqrt(6.0), -1]) / 3 @ STIFF.a
"""g, and weights e_j, of the estimate ``g (h f + sum_j e_j k_j)`` of the error of `STIFF`, of order 4.

Hairer and Wanner II, section IV.8: 1 / g is the real eigenvalue of a^-1; k_j are the increments ``h K_j``, f is the
slope before the row.
"""
STIFF_BEND = np.array([1.0 / np.prod([c - d for d in STIFF.c if d != c]) for c in STIFF.c])
STIFF_BEND /= np.abs(STIFF_BEND).max()
"""Second divided difference of the slopes at the stages of `STIFF`, whose largest weight is 1."""

STIFF_BESIDE_EXPLICIT = STIFF.pad(len(EXPLICIT.b))
"""`STIFF` in an experiment in which other modes take explicit steps: arrays of stages then have one shape for all."""


def select_tableaus(implicit: Sequence[bool]) -> tuple[Tableau, ...]:
    """Return the method of each mode, all with the same number of stages; `implicit` says which are implicit."""
    stiff = STIFF if all(implicit) else STIFF_BESIDE_EXPLICIT
    return tuple(stiff if each else EXPLICIT for each in implicit)


Array = Any
"""A JAX array, or a NumPy array of nodes."""


LARGEST_BEND = 0.3
"""Difference of the slopes of a row, relative to their range, above which f jumps in it: of a sine it is above where a
row is longer than half a period; of a jump it is 1 to 3 in an explicit row, and 0.4 to 0.6 in an implicit one."""


SMALLEST_BEND = 1e-4
"""Difference of the slopes, relative to the slope at the start of the row, below which it may be rounding."""


class Stages(NamedTuple):
    """Time (), state (n,) and slope (n,) of each stage: lists, or arrays with one more axis in front."""

    times: Any
    states: Any
    slopes: Any


def stages(
    tableau: Tableau, f: Callable[..., Array], start: Array, end: Array, x: Array, increments: Sequence[Array] = ()
) -> Stages:
    """Compute the stages of a row from the state x (n,); ``f(t, x)`` is the vector field.

    Those of an implicit row follow from its increments (s arrays (n,)), with f at them for the slopes.
    """
    h = end - start
    found = Stages([], [], [])
    for row, c in zip(tableau.a, tableau.c.tolist(), strict=True):
        found.times.append(start + c * h)
        # X_j of an explicit row from the slopes before it: a is strictly lower triangular.
        found.states.append(x + (combine(row, increments) if increments else h * combine(row, found.slopes)))
        found.slopes.append(f(found.times[-1], found.states[-1]))
    return found


SHORT = 1e-3
"""Length of a row, in times of the fastest component of f, below which its slopes are f at the stages."""


class Factors(Protocol):
    """A factorized matrix of s by s blocks (n, n)."""

    def solve(self, right: Sequence[Array], *, transposed: bool = False) -> list[Array]:
        """Return the solution for a right-hand side of s vectors (n,): s vectors (n,)."""
        ...


Factorize = Callable[[Array, Array, Sequence[Array]], Factors]
"""Factorizes the matrix of the coupled equations: a (s, s), h and f_x (s arrays (n, n)), as in `couple`."""


def couple(a: Array, h: Array, f_x: Sequence[Array]) -> list[list[Array]]:
    """Return the matrix of the coupled equations, ``I - h a_jl D_1 f_j``, in s by s blocks (n, n)."""
    unit = np.eye(f_x[0].shape[0])
    return [
        [(unit if j == m else 0.0 * unit) - (h * a_jm) * f_x[j] for m, a_jm in enumerate(row)]
        for j, row in enumerate(a.tolist())
    ]


def choose_slopes(h: Array, k: Sequence[Array], f_X: Sequence[Array], f_x: Array, xp: Any) -> list[Array]:
    """Return the slopes K of the stages, from the increments k, or f at the stages where the row is short.

    The stiff components of f amplify the rounding errors of X, those of k / h do not. But the second derivative of
    k / h in h loses all digits where h is a rounding error of a transition time, and 1 / h fails where it is zero.

    Parameters
    ----------
    k, f_X : s arrays (n,)
    f_x : (n, n), D_1 f at the start of the row
    xp : module
        jax.numpy, or the namespace of a graph.
    """
    fastest = reduce(xp.maximum, list(xp.abs(f_x).sum(axis=1)))
    is_long = xp.abs(h) * fastest > SHORT
    length = xp.where(xp.equal(h, 0.0), 1.0, h)
    return [xp.where(is_long, own / length, slope) for own, slope in zip(k, f_X, strict=True)]


def estimate_error(h: Array, k: Sequence[Array], slope: Array, f_x: Array, factorize: Factorize) -> Array:
    """Return an estimate of the error of an implicit row, (n,): Hairer and Wanner II, equation (IV.8.19).

    ``(I - h g D_1 f)^-1 g (h f + sum_j e_j k_j)``, of order 4, with f (n,) and D_1 f (n, n) at the start of the row.
    """
    right = STIFF_DAMPING * (h * slope + combine(STIFF_ERROR, k))
    (error,) = factorize(np.array([[STIFF_DAMPING]]), h, [f_x]).solve([right])
    return error


class Tangent(NamedTuple):
    """Derivatives along one direction: of the states and slopes of the stages, (n,) each, and of x+ (n,)."""

    states: list[Array]
    slopes: list[Array]
    after: Array


def tangent(
    tableau: Tableau,
    h: Array,
    slopes: Sequence[Array],
    f_x: Sequence[Array],
    forcing: Sequence[Array],
    x_d: Array,
    h_d: Array,
    factors: Factors | None = None,
) -> Tangent:
    """Differentiate a row along one direction.

    Parameters
    ----------
    h : step length ()
    slopes : s arrays (n,)
    f_x : s arrays (n, n), D_1 f at each stage
    forcing : s arrays (n,), ``D_2 f t_j' + D_p f p'``
    x_d : (n,), derivative of the state before the row
    h_d : (), derivative of the step length; None where it does not depend on theta
    factors : of the matrix of the coupled equations of an implicit row, with f_x; `adjoint` takes the same ones
    """

    def follow(start: Array, weights: FloatArray, K_d: Sequence[Array]) -> Array:
        """Return ``start + h sum_l weights_l K_l' + h' sum_l weights_l K_l``."""
        moved = start + h * combine(weights, K_d) if K_d else start
        return moved if h_d is None else moved + h_d * combine(weights, slopes)

    # X_j' = x' + h sum_l a_jl K_l' + h' sum_l a_jl K_l: along p this discretizes the linear equation whose solution is
    # (10) of the paper.
    states: list[Array] = []
    K_d: list[Array] = []
    if factors is None:
        for J, given, row in zip(f_x, forcing, tableau.a, strict=True):
            states.append(follow(x_d, row, K_d))
            K_d.append(times_vector(J, states[-1]) + given)
    else:
        # (I - h a_jl D_1 f_j) K' = D_1 f_j (x' + h' sum_l a_jl K_l) + D_2 f t_j' + D_p f p'.
        known = [follow(x_d, row, ()) for row in tableau.a]
        K_d = factors.solve([given + times_vector(J, X_d) for J, given, X_d in zip(f_x, forcing, known, strict=True)])
        states = [follow(x_d, row, K_d) for row in tableau.a]
    return Tangent(states, K_d, follow(x_d, tableau.b, K_d))


class Adjoint(NamedTuple):
    """Derivatives of the cost to go from the start of a row.

    Attributes
    ----------
    states : s arrays mu_j (n,), in the states of the stages
    before : (n,), in the state before the row
    times : s entries (), of ``w_j . f + h b_j ell`` in t_j
    parameters : (M,), the sum of the same in p
    """

    states: list[Array]
    before: Array
    times: list[Array]
    parameters: Array


Pull = Callable[[int, Array, Array], tuple[Array, Array, Array]]
"""``pull(j, w, hb)``: derivatives of ``w . f + hb ell`` at stage j in t (), x (n,) and p (M,)."""


def adjoint(
    tableau: Tableau, h: Array, psi: Array, pull: Pull, ell_x: Sequence[Array] = (), factors: Factors | None = None
) -> Adjoint:
    """Pull the costate psi (n,) after a row back to its start; of an implicit row by its factors, and with D_1 ell at
    each stage, s arrays (n,).
    """
    a, b, s = tableau.a, tableau.b.tolist(), len(tableau.b)
    unknown: list[list[Array]] = [[None] * s for _ in range(3)]
    w, mu, times = unknown
    parameters: Array = 0.0
    if factors is not None:
        # mu_l = D_1 f_l' w_l + h b_l D_1 ell_l put into w_j = h b_j psi + h sum_l a_lj mu_l leaves a system in w alone,
        # with the transposed matrix of the tangent:
        #     w_j - h sum_l a_lj D_1 f_l' w_l = h b_j psi + h sum_l a_lj h b_l D_1 ell_l
        costs = [(h * b[j]) * ell_x[j] for j in range(s)]
        right = [h * (b[j] * psi + combine(a[:, j], costs)) for j in range(s)]
        w = factors.solve(right, transposed=True)
    # Explicit: last stage first, since w_j needs mu_l of the stages that use K_j, those behind it. This discretizes (7)
    # of the paper.
    for j in reversed(range(s)) if factors is None else range(s):
        if factors is None:
            later = combine(a[j + 1 :, j], mu[j + 1 :])
            w[j] = h * (b[j] * psi + later)
        times[j], mu[j], in_p = pull(j, w[j], h * b[j])
        parameters = parameters + in_p
    return Adjoint(mu, psi + sum(mu[1:], mu[0]), times, parameters)


def length_factor(
    tableau: Tableau, psi: Array, mu: Sequence[Array], slopes: Sequence[Array], densities: Sequence[Array]
) -> Array:
    """Return V, the derivative of the cost to go in the length of a row at fixed times of its stages: ().

    V is linear in the slopes K_j (n,) and the densities ell_j (): with K_j' and ell_j' the result is its derivative.
    """
    total: Array = 0.0
    for j, b in enumerate(tableau.b.tolist()):
        # h stands in x+ and in the cost of the row, h b_j (K_j, ell_j), and in the states of the stages, h a_jl K_l.
        if b:
            total = total + b * ((psi * slopes[j]).sum() + densities[j])
        if tableau.a[j].any():
            total = total + (mu[j] * combine(tableau.a[j], slopes)).sum()
    return total


def measure_jump(first: Array, middle: Array, last: Array, bend: Array, smooth: Array, xp: Any) -> Array:
    """Return h times the jump of f inside a row, (n,); 0 where f seems smooth.

    Parameters
    ----------
    first, middle, last : (n,), h times the slopes of three stages
    bend : (n,), a difference of high order of all of them
    smooth : (n,), h times the change of f from the first to the last stage by the mean of its derivatives there

    Where f is smooth, a difference of high order of the slopes is small beside their range, and the derivatives at the
    first and the last stage explain how the slope changes. Where f jumps, neither holds. The state after such a row may
    be accurate, if it is short, but its derivatives have nothing of how the place of the jump moves.
    """
    change, bend = last - first, xp.abs(bend)
    rest = xp.abs(change - smooth)
    # A jump is what neither the smoothness of f nor its derivatives explain: the smaller of bend and rest counts.
    span = xp.maximum(xp.abs(change), xp.abs(middle - first))
    least = LARGEST_BEND * span + SMALLEST_BEND * xp.abs(first)
    return xp.where(xp.less(least, xp.minimum(bend, rest)), bend, 0.0)


def invert_stages(tableau: Tableau) -> FloatArray:
    """Return the matrix that makes h times the slopes (s, n) of the states at the stages after the row's start (s, n).

    The states, minus that at the start, are those of all stages; of an explicit method, whose first stage is the start,
    those of the others, then that at the end of the row.
    """
    # X - x = a (h K); of an explicit method the first row of a is zero, and b, the row of x+, takes its place.
    return np.asarray(np.linalg.inv(tableau.a if tableau.coupled else np.vstack([tableau.a[1:], tableau.b])))


def times_derivative(tableau: Tableau, start_d: Array, end_d: Array) -> list[Array]:
    """Return the derivatives of the times of the stages, ``start' + c_j h'``: s entries ()."""
    h_d = end_d - start_d
    return [start_d + c * h_d for c in tableau.c.tolist()]


def combine(weights: Sequence[float] | FloatArray, terms: Sequence[Array] | FloatArray) -> Array:
    """Add terms with weights; terms of weight zero are skipped, and the sum of no terms is 0.

    The terms may be one NumPy array, along its first axis.
    """
    if isinstance(terms, np.ndarray) and terms.dtype != object:
        return np.asarray(weights)[: len(terms)] @ terms
    given = weights.tolist() if isinstance(weights, np.ndarray) else weights
    parts = [w * term for w, term in zip(given, terms, strict=False) if w != 0.0]
    return sum(parts[1:], parts[0]) if parts else 0.0


def times_vector(A: Array, v: Array) -> Array:
    """Return ``A v`` for small A (m, n) and v (n,) as products and a sum, without the overhead of a library call."""
    return (A * v[None]).sum(-1)


SAFETY, SMALLEST_FACTOR, LARGEST_FACTOR = 0.9, 0.2, 10.0

EPS, SMALLEST = float(np.finfo(float).eps), float(np.nextafter(0.0, 1.0))

EXPONENT, STIFF_EXPONENT = -1 / 5, -1 / 4
"""Minus one over the order of the error, one more than that of the estimate, of explicit and of implicit steps."""


class Tolerances(NamedTuple):
    """Relative and absolute tolerance of a step: (), ()."""

    rtol: Array
    atol: Array


class Progress(NamedTuple):
    """State of an adaptive solve.

    Attributes
    ----------
    t : (), time reached
    step : (), size of the next step
    refused : whether the last step was rejected
    stuck : whether the next step would not change t, or is NaN: the solve has failed
    """

    t: Array
    step: Array
    refused: Array
    stuck: Array


def error_norm(error: Array, y: Array, after: Array, tolerances: Tolerances, xp: Any = np) -> Array:
    """Return the root mean square of an error (n,), relative to the tolerances for a step from y to `after`."""
    relative = error / (tolerances.atol + tolerances.rtol * xp.maximum(xp.abs(y), xp.abs(after)))
    return xp.sqrt((relative * relative).sum() / len(y))


def shortest_step(t: Array, xp: Any = np) -> Array:
    """Return the shortest step to try at t: about ten units in the last place."""
    return xp.maximum(10.0 * EPS * xp.abs(t), 10.0 * SMALLEST)


def limit_step(t: Array, step: Array, end: Array, xp: Any = np) -> Array:
    """Return the step, shortened so that it does not pass the end."""
    return xp.where(end <= t + step, end - t, step)


def judge_error(
    at: Progress, end: Array, tolerances: Tolerances, y: Array, after: Array, error: Array, exponent: float, xp: Any
) -> tuple[Progress, Array]:
    """Accept or reject a step from y to `after`, (n,) each, with an error (n,); choose the size of the next one."""
    norm = error_norm(error, y, after, tolerances, xp)
    accepted = norm < 1.0
    # h+ = h min(largest, max(0.2, 0.9 norm^(-1/q))), q the order of the error; after a rejection it does not grow.
    largest = xp.where(at.refused, 1.0, LARGEST_FACTOR)
    factor = xp.minimum(xp.maximum(SAFETY * xp.float_power(norm, exponent), SMALLEST_FACTOR), largest)
    step = at.step * xp.where(norm >= 0.0, factor, SMALLEST_FACTOR)  # comparisons with a NaN norm are false
    # Comparisons with a NaN step size are false: the solve is stuck, instead of trying for ever.
    stuck = ~(accepted | (shortest_step(at.t, xp) <= step))
    t = xp.where(accepted, xp.where(end - at.t <= at.step, end, at.t + at.step), at.t)
    step = xp.where(accepted, xp.maximum(step, shortest_step(t, xp)), step)
    now = Progress(t, limit_step(t, step, end, xp), ~accepted, stuck)
    return now, xp.where(accepted, after, y)


def first_step(
    slope: Callable[..., FloatArray], t: float, y: FloatArray, end: float, tolerances: Tolerances, exponent: float
) -> float:
    """Choose the size of the first step from ``slope(t, y)`` at y (n,), and one more slope (Hairer et al. I, II.4).

    NaN if a slope is not finite.
    """
    K = slope(t, y)
    with np.errstate(all="ignore"):
        if not np.isfinite(K).all():
            return np.nan
        of_state, of_slope = (float(error_norm(each, y, y, tolerances)) for each in (y, K))
        if not np.isfinite(of_slope):  # its square overflows: the first step will fail, with a message
            return min(1e-6, end - t)
        # An Euler step h_0 that moves y by 1 % of its size, then h_1 from (h_1)^q max(|f|, |df| / h_0) = 0.01: the
        # smaller of h_1 and 100 h_0 (Hairer, Norsett and Wanner I, section II.4).
        guess = min(1e-6 if of_state < 1e-5 or of_slope < 1e-5 else 0.01 * of_state / of_slope, end - t)
        step = 0.0
        if guess > 0.0:
            ahead = min(t + guess, float(np.nextafter(end, t)))
            bend = float(error_norm(slope(ahead, y + guess * K) - K, y, y, tolerances)) / guess
            flat = of_slope <= 1e-15 and bend <= 1e-15
            step = max(1e-6, guess * 1e-3) if flat else (0.01 / max(of_slope, bend)) ** -exponent
        step = min(100.0 * guess, step)
        return float(limit_step(t, max(step, float(shortest_step(t))), end))
