"""The paper's derivatives, equations (6)-(17): optimize, then discretize.

Reference: L. M. Miller and T. D. Murphey, sections III and IV. Equation numbers at the lines are the paper's, and so
are the names: ``f``, ``X`` (the jump X^i of the vector field), ``psi``, ``Omega``, ``Omega_p``, ``Phi``, ``Dp_x``,
``X_ii``, ``X_ij``, ``X_taup``; ``D1`` is the derivative in x, ``D2`` that in t, ``Dp`` that in p; ``f_im1`` is f_{i-1}.
The paper has J = int ell(t, x) dt and a continuous x. The formulas here are extended as follows, and reduce to the
paper's without these extensions. Misprints of the paper are corrected, with a comment at the line.

**Costs.** ell(t, x, p) may depend on p, which adds D_p ell to (9), D_pD_1 ell to (15) and the derivatives of D_p ell to
(14). At a sample ell_k(x(t_k), p) the adjoints jump, and the terminal cost phi(x, p) gives their values at tf:

    psi- = psi+ + D ell_k,    Omega- = Omega+ + D^2 ell_k,    Omega_p- = Omega_p+ + D^2 ell_k D_p x + D_pD_1 ell_k.

**Initial state.** x(t0) = x0(p): D_p x starts at D_p x0; (9) gains psi D_p x0, (14) D_p x0' Omega_p + psi . D_p^2 x0.

**Reset maps.** x(tau_i+) = R(tau_i, x(tau_i-), p). At the same end of mode i - 1 define

    F_{i-1}(t, x, p) = D_t R + D_x R f_{i-1}(t, x, p)              the velocity f_{i-1} carried through R,
    Lambda(t, x, p)  = ell(t, x, p) - ell(t, R(t, x, p), p)        the jump of ell, 0 without a reset map,

so that x(tau_i+) moves with F_{i-1} as tau_i moves, and X^i = F_{i-1}(x-) - f_i(x+). For V, the cost to go of mode i,
psi = D_x V and D_t V + ell + psi f_i = 0, the derivative of ``V(tau, R(tau, x-, p), p)`` and of the cost up to tau is

    D_{tau_i} J = Lambda + psi(tau_i+) X^i.

Its total derivatives give the second order. They use that psi(tau_i+) changes with tau_i by psi_dot + X^i' Omega,
psi_dot being (7) (the paper's step from (6) to (11)), with tau_j, j < i, by Omega D_x R Phi X^j, and with p by Omega_p:

    i = j :  D_2 Lambda + D_1 Lambda f_{i-1} - D ell X^i + psi X^{ii} + X^i' Omega X^i,
             X^{ii} = D_1 f_i f_i + D_1 F_{i-1} f_{i-1} - 2 D_1 f_i F_{i-1} + D_2 F_{i-1} - D_2 f_i
    i > j :  (D_1 Lambda + psi [D_1 F_{i-1} - D_1 f_i D_x R] + X^i' Omega D_x R) Phi(tau_i-, tau_j) X^j
    tau, p:  D_1 Lambda D_p x- + D_p Lambda + psi X^{tau,p} + X^i' Omega_p,
             X^{tau,p} = D_1 F_{i-1} D_p x- - D_1 f_i D_p x+ + D_p F_{i-1} - D_p f_i
    p, p  :  D_p R' Omega_p + psi . [D_p^2 R + D_1 D_p R D_p x-]  at each transition, added to (14).

All of f_i, D ell, psi, Omega, Omega_p are at (tau_i, x(tau_i+)). Thus (11), (13), (16) and (17) hold as they are
printed, with F_{i-1} in place of f_{i-1}. Through the map itself

    D_p x+ = D_x R D_p x- + D_p R,      psi- = psi+ D_x R,      Omega- = D_x R' Omega+ D_x R + psi+ . D_x^2 R,
    Omega_p- = D_x R' Omega_p+ + psi+ . [D_x^2 R D_p x- + D_p D_x R],      and (9) gains psi+ D_p R.

**A free tf** is the transition to a mode with f = 0 and ell = 0, so that x remains x(tf) until the end of the mesh. All
of the above holds for it, with Lambda = ell(tf, x, p) and X = f_N: D_tf J = ell + psi f_N, where psi is D phi.

**Integration.** Forward and backward with the same Runge-Kutta method over the same rows of the mesh. In the backward
sweep x(t) comes from quintic Hermite interpolation, since integrating x backward would blow up stiff modes.
The result differs from the derivatives of the discretized cost (`switchfit.engine.jax`), which the
optimizer uses, by the integration error. This module serves to verify that the gap closes at the integrator's order.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree

from switchfit.arrays import Traced
from switchfit.discretization.arguments import Arguments, Samples
from switchfit.discretization.mesh import find_row_ending_cell
from switchfit.discretization.model import Field, Model
from switchfit.discretization.path_costs import compute_path_cost
from switchfit.discretization.propagation import Path, pick_at_cells, propagate, switch_method, switch_mode
from switchfit.discretization.rows import combine
from switchfit.discretization.runge_kutta import Tableau
from switchfit.discretization.sampled_states import find_late_rows, step_to_late_sample
from switchfit.discretization.signals import Piece
from switchfit.problem.structure import Structure

Given = TypeVar("Given")
State = TypeVar("State")
"""An array, or a tuple of arrays."""

Array = jax.Array
Function = Callable[[Array, Array, Array], Array]


class Sensitivities(NamedTuple):
    """Quantities that the forward sweep integrates in addition to x: Phi(t, tau_j) X^j, (n, N), and D_p x, (n, M)."""

    Phi_X: Array
    Dp_x: Array


class Adjoints(NamedTuple):
    """Quantities that the backward sweep integrates: psi (n,), Omega (n, n) and Omega^p (n, M)."""

    psi: Array
    Omega: Array
    Omega_p: Array


class Quadratures(NamedTuple):
    """Integrals over time: D_p J (M,), equation (9), and D_p D_p J (M, M), equation (14)."""

    Dp_J: Array
    DpDp_J: Array


class Slopes(NamedTuple):
    """A function of (t, x, p) with m values at one point: its value (m,), D1 (m, n), D2 (m,) and Dp (m, M)."""

    value: Array
    D1: Array
    D2: Array
    Dp: Array


class Bends(NamedTuple):
    """First and second derivatives in x and p of such a function; the outermost derivative is the last axis.

    D1 (m, n), Dp (m, M), D1D1 (m, n, n), DpD1 (m, n, M), D1Dp (m, M, n), DpDp (m, M, M).
    """

    D1: Array
    Dp: Array
    D1D1: Array
    DpD1: Array
    D1Dp: Array
    DpDp: Array


class Along(NamedTuple):
    """D_p x (n, M) on the trajectory at one time, and the derivatives of f and ell there."""

    Dp_x: Array
    f: Bends
    ell: Bends


class TransitionQuantities(NamedTuple):
    """All quantities at one transition time tau_i that need only x: before (x-) and after (x+) the reset map.

    Attributes
    ----------
    X : (n,), the jump X^i
    xdot : (n,), f_{i-1}(x-) itself
    f_im1
        f_{i-1} carried through R: F_{i-1} above; f_{i-1} itself without a reset map
    f_i
        f_i at x+
    Lambda
        the jump of ell
    Dell : (n,), D ell at x+
    R
        derivatives of the reset map
    """

    X: Array
    xdot: Array
    f_im1: Slopes
    f_i: Slopes
    Lambda: Slopes
    Dell: Array
    R: Bends


def compute_paper_derivatives(model: Model, tau: Array, p: Array, side: Array) -> tuple[Array, Array, Array]:
    """Return the cost, gradient and Hessian by the paper's adjoint equations.

    Parameters
    ----------
    model : Model
    tau : (N,)
        Transition times in the experiment's time unit, not decreasing.
    p : (M,)
        Free parameters.
    side : ()
        +1 or -1: which one-sided derivative to return at a transition time that equals a node of the mesh.

    Returns
    -------
    cost : ()
    gradient : (N + M,)
        Equation (5): D_tau J by (6), and D_p J by (9).
    hessian : (N + M, N + M)
        Equation (3), from (11), (14) and (16). The tau block is computed for i >= j and mirrored, the cross block
        computed once; the p block is that of (14), symmetric up to the integration error.

    Notes
    -----
    With the stiff solver, each row takes a dense solve of 3 (n + n^2 + n M) unknowns: use it for small n only.
    """
    path = propagate(model, tau, p, side)
    transitions = [evaluate_transition(model, path, i, tau[i], p) for i in range(model.structure.N)]
    before, after = integrate_sensitivities(model, path, transitions, p)
    start, opened, total = sweep_backward(model, path, transitions, before.Dp_x, after.Dp_x, p)
    total = add(total, add_initial_state(model, start, p))

    D_tau_J, rows_tau = [], []
    for i, here in enumerate(transitions):
        # Row that opens segment i + 1: its start is tau_i+, and the end of the row before it tau_i-.
        opening = path.layout.first_row[i + 1]
        adjoints: Adjoints = pick(opened, opening)
        minus, plus = pick(after, opening - 1), pick(before, opening)
        total = add(total, add_reset(here, adjoints, minus.Dp_x))
        D_tau_J.append(here.Lambda.value + adjoints.psi @ here.X)  # (6), Lambda = 0 without a reset map
        of_tau, of_p = compute_tau_tau(i, here, adjoints, minus, plus), compute_tau_p(here, adjoints, minus, plus)
        rows_tau.append(jnp.concatenate([of_tau, of_p]))

    gradient = jnp.concatenate([jnp.array(D_tau_J), total.Dp_J])
    return compute_path_cost(model, path, p), gradient, assemble(rows_tau, total.DpDp_J)


def assemble(rows_tau: list[Array], DpDp_J: Array) -> Array:
    """Return the Hessian, equation (3), from rows (N + M,) of the tau block, zero for j > i, and the p block."""
    rows = jnp.array(rows_tau).reshape(len(rows_tau), len(rows_tau) + len(DpDp_J))
    tau, cross = rows[:, : len(rows)], rows[:, len(rows) :]
    return jnp.block([[tau + jnp.tril(tau, -1).T, cross], [cross.T, DpDp_J]])


# Equations (11), (13), (16), (17), at a transition time


def compute_tau_tau(
    i: int, here: TransitionQuantities, adjoints: Adjoints, minus: Sensitivities, plus: Sensitivities
) -> Array:
    """Return D_{tau_j} D_{tau_i} J for all j <= i, equations (11) and (13): (N,), zero for j > i."""
    psi, Omega, _ = adjoints
    X, xdot, f_im1, f_i, Lambda, Dell, _ = here
    X_ii = f_i.D1 @ f_i.value + f_im1.D1 @ xdot - 2 * f_i.D1 @ f_im1.value + f_im1.D2 - f_i.D2  # (13), i = j
    second = Lambda.D2 + Lambda.D1 @ xdot  # the jump of ell at a reset map, else 0
    second = second - Dell @ X + psi @ X_ii + X @ Omega @ X  # (11), i = j
    row = jnp.zeros(minus.Phi_X.shape[1]).at[i].set(second)
    for j in range(i):
        # (13), i > j. Misprint: the paper has D1 f_{i-1} at (x(tau_i), tau_j); both Jacobians are at tau_i.
        X_ij = f_im1.D1 @ minus.Phi_X[:, j] - f_i.D1 @ plus.Phi_X[:, j]
        # Phi X^j at tau_i- and, through the map, at tau_i+: the paper's one where there is none.
        second = Lambda.D1 @ minus.Phi_X[:, j] + psi @ X_ij + X @ Omega @ plus.Phi_X[:, j]  # (11), i > j
        row = row.at[j].set(second)
    return row


def compute_tau_p(here: TransitionQuantities, adjoints: Adjoints, minus: Sensitivities, plus: Sensitivities) -> Array:
    """Return D_{tau_i} D_p J, equation (16): (M,)."""
    psi, _, Omega_p = adjoints
    X_taup = here.f_im1.D1 @ minus.Dp_x - here.f_i.D1 @ plus.Dp_x + here.f_im1.Dp - here.f_i.Dp  # (17)
    jump = here.Lambda.D1 @ minus.Dp_x + here.Lambda.Dp  # the jump of ell at a reset map, else 0
    return jump + psi @ X_taup + here.X @ Omega_p  # (16)


def evaluate_transition(model: Model, path: Path, i: int, tau_i: Array, p: Array) -> TransitionQuantities:
    """Return the vector fields, ell and the reset map on both sides of transition i (from 0), equation (8)."""
    opening = path.layout.first_row[i + 1]
    piece: Piece = pick(path.pieces, opening)
    modes = model.structure.mode_of_segment
    f_before, f_after = model.field(modes[i], piece), model.field(modes[i + 1], piece)
    ell_before, ell_after = model.density(modes[i], piece), model.density(modes[i + 1], piece)
    R = model.reset(i) if i in model.structure.resets else lambda t, x, p: x

    def carry_over(t: Array, x: Array, p: Array) -> Array:
        """Return F_{i-1} = D_t R + D_x R f_{i-1}, which is f_{i-1} without a reset map."""
        direction = (jnp.ones(()), f_before(t, x, p), jnp.zeros_like(p))
        return jax.jvp(R, (t, x, p), direction)[1]

    def Lambda(t: Array, x: Array, p: Array) -> Array:
        return ell_before(t, x, p) - ell_after(t, R(t, x, p), p)

    minus, plus = (tau_i, path.after[opening - 1], p), (tau_i, path.before[opening], p)
    f_im1, f_i = differentiate(carry_over, *minus), differentiate(f_after, *plus)
    X = f_im1.value - f_i.value  # (8)
    Dell, R_twice = jax.grad(ell_after, argnums=1)(*plus), differentiate_twice(R, *minus)
    return TransitionQuantities(X, f_before(*minus), f_im1, f_i, differentiate(Lambda, *minus), Dell, R_twice)


# The forward sweep: equation (10) and the columns of Phi


def integrate_sensitivities(
    model: Model, path: Path, transitions: list[TransitionQuantities], p: Array
) -> tuple[Sensitivities, Sensitivities]:
    """Return Phi(t, tau_j) X^j and D_p x at the start and at the end of each row: (R, n, N) and (R, n, M) arrays."""
    n, N = model.structure.n, model.structure.N
    D1R = jnp.stack([jnp.eye(n), *(t.R.D1 for t in transitions)])
    DpR = jnp.stack([jnp.zeros((n, p.shape[0])), *(t.R.Dp for t in transitions)])
    X_columns = jnp.zeros((N + 1, n, N))
    for i, here in enumerate(transitions):
        X_columns = X_columns.at[i + 1, :, i].set(here.X)

    def of_mode(mode: int) -> Callable[..., tuple[Array, Array]]:
        def stages(start: Array, end: Array, piece: Piece, states: Array) -> tuple[Array, Array]:
            jacobians = jax.jacfwd(model.field(mode, piece), argnums=(1, 2))
            times = start + model.tableaus[mode].c * (end - start)
            return jax.vmap(lambda t, x: jacobians(t, x, p))(times, states)

        return stages

    # Column j is Phi(t, tau_j) X^j: zero before tau_j, X^j there, then z_dot = D_1 f z, as below (10).
    def rate(given: tuple[Array, Array], now: Sensitivities) -> Sensitivities:
        D1f, Dpf = given
        return Sensitivities(D1f @ now.Phi_X, D1f @ now.Dp_x + Dpf)  # (10) as a differential equation

    def row(now: Sensitivities, given: tuple[Traced, ...]) -> tuple[Sensitivities, tuple[Sensitivities, Sensitivities]]:
        segment, opens, start, end, piece, states = given
        # The columns X^i begin at tau_i. Misprint in the display before (10): segment k integrates from tau_k, not t0.
        jumped = Sensitivities(D1R[segment] @ now.Phi_X + X_columns[segment], D1R[segment] @ now.Dp_x + DpR[segment])
        now = where(opens, jumped, now)
        jacobians = switch_mode(model, segment, of_mode, start, end, piece, states)

        def step(tableau: Tableau) -> Callable[..., Sensitivities]:
            return lambda now, jacobians: step_linear(tableau, rate, end - start, jacobians, now)[1]

        after = switch_method(model, segment, step, now, jacobians)
        return after, (now, after)

    layout = path.layout
    first = Sensitivities(jnp.zeros((n, N)), jax.jacfwd(model.initial_state)(p))
    given = (layout.segment, layout.opens, layout.start, layout.end, path.pieces, path.stages)
    return lax.scan(row, first, given)[1]


# The backward sweep: equations (7), (12), (15) and the integrals (9), (14)


def evaluate_adjoint_rate(d: Along, adjoints: Adjoints) -> Adjoints:
    """Return right-hand sides of the adjoint equations at one time; affine in the adjoints."""
    psi, Omega, Omega_p = adjoints
    Dp_x, f, ell = d
    psi_dot = -ell.D1 - psi @ f.D1  # (7)
    Omega_dot = -ell.D1D1 - contract(psi, f.D1D1) - f.D1.T @ Omega - Omega @ f.D1  # (12)
    # (15), extended by D_pD_1 ell
    Omega_p_dot = -ell.D1D1 @ Dp_x - ell.DpD1 - f.D1.T @ Omega_p - contract(psi, f.D1D1 @ Dp_x + f.DpD1)
    return Adjoints(psi_dot, Omega_dot, Omega_p_dot)


def evaluate_integrands(d: Along, adjoints: Adjoints) -> Quadratures:
    """Return integrands of D_p J and D_p D_p J, extended by the terms in ell.

    Misprint: (15) is followed by an integral sign without meaning.
    """
    psi, _, Omega_p = adjoints
    Dp_x, f, ell = d
    first = psi @ f.Dp + ell.Dp  # (9)
    of_f = f.Dp.T @ Omega_p + contract(psi, f.DpDp) + contract(psi, f.D1Dp @ Dp_x)
    second = of_f + ell.DpDp + ell.D1Dp @ Dp_x  # (14)
    return Quadratures(first, second)


def sweep_backward(
    model: Model, path: Path, transitions: list[TransitionQuantities], Dp_x_before: Array, Dp_x_after: Array, p: Array
) -> tuple[Adjoints, Adjoints, Quadratures]:
    """Return the adjoints at t0, those at the start of each row (R, ...; at tau_i+ if it opens a segment), and (9),
    (14).

    `Dp_x_before` and `Dp_x_after` (R, n, M) are D_p x at the start and at the end of each row.
    """
    final, total = add_point_cost(model.terminal, path.after[-1], Dp_x_after[-1], p)
    jumps, late, sampled = add_sample_jumps(model, path, Dp_x_before, Dp_x_after, p)
    total = add(total, sampled)

    def step(tableau: Tableau) -> Callable[..., tuple[Adjoints, Quadratures]]:
        def back(adjoints: Adjoints, total: Quadratures, h: Array, d: Along) -> tuple[Adjoints, Quadratures]:
            states, adjoints = step_linear(tableau, evaluate_adjoint_rate, -h, d, adjoints)
            rates, b = jax.vmap(evaluate_integrands)(d, states), jnp.asarray(tableau.b)
            return adjoints, jax.tree.map(lambda a, r: a + h * jnp.tensordot(b, r, 1), total, rates)

        return back

    def row(
        now: tuple[Adjoints, Quadratures], given: tuple[Traced, ...]
    ) -> tuple[tuple[Adjoints, Quadratures], Adjoints]:
        segment, opens, jump, late, start, end, *trajectory = given
        adjoints, total = now
        d = differentiate_along_row(model, segment, p, start, end, *trajectory)
        # Backward through a row: samples at its end add their jumps, then (7), (12) and (15), with (9) and (14) as
        # quadratures of the same stages; at a transition the adjoints at tau_i+ are kept before they go through the map
        # to tau_i-.
        opened, total = switch_method(model, segment, step, add(adjoints, jump), total, end - start, d)
        opened = add(opened, late)
        return (pass_reset(transitions, segment, opens, opened, pick(Dp_minus, segment)), total), opened

    layout = path.layout
    Dp_minus = jnp.concatenate([jnp.zeros_like(Dp_x_before[:1]), Dp_x_after[layout.first_row[1:] - 1]])
    rows = (layout.start, layout.end, path.pieces, path.before, path.after, Dp_x_before, Dp_x_after)
    given = (layout.segment, layout.opens, pick(jumps, slice(1, None)), late, *rows)
    (start, total), opened = lax.scan(row, (final, total), given, reverse=True)
    return add(start, pick(jumps, 0)), opened, total


def differentiate_along_row(
    model: Model, segment: Array, p: Array, start: Array, end: Array, piece: Piece, *values: Array
) -> Along:
    """Return `Along` at the stages of the backward sweep through a row, (s, ...).

    `values` are x and D_p x at the start and at the end of the row: x_k, x_{k+1}, D_p x_k, D_p x_{k+1}.
    """
    # Stage j of a row, integrated from its end to its start.
    parts = jnp.stack([1.0 - tableau.c for tableau in model.tableaus])[model.mode_of_segment[segment]]
    times, directions = start + parts * (end - start), jnp.eye(p.shape[0])

    def of_mode(mode: int) -> Callable[..., tuple[Array, Array, Bends]]:
        f = model.field(mode, piece)

        def stage(s: Array, t: Array, x_k: Array, x_k1: Array, *Dp_x: Array) -> tuple[Array, Array, Bends]:
            # D_p x at a stage is the derivative of the interpolated x, so that both belong to one curve.
            x, linear = jax.linearize(lambda *ends: interpolate(f, s, start, end, *ends), x_k, x_k1, p)
            columns = jax.vmap(linear, in_axes=-1, out_axes=-1)(*Dp_x, directions)
            return x, columns, differentiate_twice(f, t, x, p)

        return jax.vmap(stage, in_axes=(0, 0, None, None, None, None))

    def of_ell(mode: int) -> Callable[..., Bends]:
        return jax.vmap(lambda t, x: differentiate_twice(model.density(mode, piece), t, x, p))

    x, Dp_x, f = switch_mode(model, segment, of_mode, parts, times, *values)
    if not model.structure.has_free_tf:  # the same in all modes
        return Along(Dp_x, f, of_ell(0)(times, x))
    return Along(Dp_x, f, switch_mode(model, segment, of_ell, times, x))


def interpolate(f: Field, s: Array, start: Array, end: Array, x_k: Array, x_k1: Array, p: Array) -> Array:
    """Return x at ``start + s (end - start)``, s in [0, 1], by quintic Hermite interpolation of one row: (n,).

    From x, x_dot = f and x_ddot = D_2 f + D_1 f f at both ends; the error is of order 6 in the row's length.
    """
    h = end - start

    def derivatives(t: Array, x: Array) -> tuple[Array, Array]:
        velocity = f(t, x, p)
        return velocity, jax.jvp(lambda t, x: f(t, x, p), (t, x), (jnp.ones(()), velocity))[1]

    (v_k, a_k), (v_k1, a_k1) = derivatives(start, x_k), derivatives(end, x_k1)
    s3, s4, s5 = s**3, s**4, s**5
    # The polynomial of degree 5 with these values, slopes and second derivatives at s = 0 and s = 1.
    weight = 10 * s3 - 15 * s4 + 6 * s5
    slopes = (s - 6 * s3 + 8 * s4 - 3 * s5) * v_k + (-4 * s3 + 7 * s4 - 3 * s5) * v_k1
    bends = (0.5 * s**2 - 1.5 * s3 + 1.5 * s4 - 0.5 * s5) * a_k + (0.5 * s3 - s4 + 0.5 * s5) * a_k1
    return (1 - weight) * x_k + weight * x_k1 + h * slopes + h**2 * bends


# Jumps: samples, the terminal cost, reset maps, the initial state


def add_point_cost(
    cost: Callable[[Array, Array], Array], x: Array, Dp_x: Array, p: Array
) -> tuple[Adjoints, Quadratures]:
    """Return the contributions of a cost of x at one time, a sample or the terminal cost, to the adjoints there and
    to (9), (14).
    """
    ell = differentiate_twice(lambda t, x, p: cost(x, p), jnp.zeros(()), x, p)
    # psi- - psi+ = D ell_k, and so on: see "Costs" above.
    jump = Adjoints(ell.D1, ell.D1D1, ell.D1D1 @ Dp_x + ell.DpD1)
    return jump, Quadratures(ell.Dp, ell.DpDp + ell.D1Dp @ Dp_x)


def add_sample_jumps(
    model: Model, path: Path, Dp_x_before: Array, Dp_x_after: Array, p: Array
) -> tuple[Adjoints, Adjoints, Quadratures]:
    """Return the jumps of the adjoints at t0 and at the end of each row (R + 1, ...), those at the start of each row
    (R, ...), and the contributions of samples to (9), (14).

    A late sample is a cost of the state at the start of the row that holds ``t - delay``, any other one of that at the
    end of its row, or at t0.
    """
    (R, n), M = path.after.shape, p.shape[0]
    ends = Adjoints(jnp.zeros((R + 1, n)), jnp.zeros((R + 1, n, n)), jnp.zeros((R + 1, n, M)))
    starts, total = pick(ends, slice(1, None)), Quadratures(jnp.zeros(M), jnp.zeros((M, M)))
    for k, (sensor, samples) in enumerate(zip(model.structure.measurements, model.arguments.samples, strict=True)):

        def add_late(Dp_x: Array, x: Array, sample: Samples, *row: Traced, k: int = k) -> tuple[Adjoints, Quadratures]:
            segment, piece, start = row

            def cost(x: Array, p: Array) -> Array:
                there, x_s = step_to_late_sample(model, k, sample, segment, piece, start, x, p)
                return model.sample_cost(k, there, x_s, p)

            return add_point_cost(cost, x, Dp_x, p)

        def add_own(Dp_x: Array, x: Array, sample: Samples, k: int = k) -> tuple[Adjoints, Quadratures]:
            return add_point_cost(lambda x, p: model.sample_cost(k, sample, x, p), x, Dp_x, p)

        if sensor.delay is not None:
            row, *of_rows, x = find_late_rows(model, path, k, p)
            jump, added = jax.vmap(add_late)(Dp_x_before[row], x, samples, *of_rows)
            starts = scatter(starts, row, jump)
        else:
            Dp_x = pick_at_cells(path.layout, Dp_x_before, Dp_x_after, samples.cell)
            jump, added = jax.vmap(add_own)(Dp_x, path.at_samples(samples.cell), samples)
            # 0 is t0
            ends = scatter(ends, find_row_ending_cell(path.layout.first_cell, samples.cell) + 1, jump)
        total = add(total, jax.tree.map(lambda a: a.sum(0), added))
    return ends, starts, total


def pass_reset(
    transitions: list[TransitionQuantities], segment: Array, opens: Array, adjoints: Adjoints, Dp_x: Array
) -> Adjoints:
    """Return the adjoints at tau_i- from those at tau_i+, where a row opens a segment; `Dp_x` is that at tau_i-."""

    def through(here: TransitionQuantities) -> Adjoints:
        (psi, Omega, Omega_p), R = adjoints, here.R
        return Adjoints(
            psi @ R.D1,
            R.D1.T @ Omega @ R.D1 + contract(psi, R.D1D1),
            R.D1.T @ Omega_p + contract(psi, R.D1D1 @ Dp_x + R.DpD1),
        )

    for i, here in enumerate(transitions):
        adjoints = where(opens & (segment == i + 1), through(here), adjoints)
    return adjoints


def add_reset(here: TransitionQuantities, adjoints: Adjoints, Dp_x: Array) -> Quadratures:
    """Return the contributions of the reset map's own dependence on p to (9) and (14); `Dp_x` (n, M) is at tau_i-."""
    (psi, _, Omega_p), R = adjoints, here.R
    return Quadratures(psi @ R.Dp, R.Dp.T @ Omega_p + contract(psi, R.DpDp + R.D1Dp @ Dp_x))


def add_initial_state(model: Model, adjoints: Adjoints, p: Array) -> Quadratures:
    """Return the contributions of an initial state x0(p) to (9) and (14)."""
    Dp_x0 = jax.jacfwd(model.initial_state)(p)
    DpDp_x0 = jax.jacfwd(jax.jacfwd(model.initial_state))(p)
    psi, _, Omega_p = adjoints
    return Quadratures(psi @ Dp_x0, Dp_x0.T @ Omega_p + contract(psi, DpDp_x0))


# Tools


def step_linear(
    tableau: Tableau, rate: Callable[[Given, State], State], h: Array, given: Given, y: State
) -> tuple[State, State]:
    """Return one Runge-Kutta step of ``dy/dt = rate(given, y)``, affine in y: its stage states (s, ...) and y at its
    end.

    `given` has the time-dependent arguments of `rate` at the s stages; h < 0 steps backward.
    """
    flat, unravel = ravel_pytree(y)
    a, b, c = tableau.a, tableau.b, tableau.c

    def slope(given: Given, y: Array) -> Array:
        return ravel_pytree(rate(given, unravel(y)))[0]

    if tableau.coupled:
        # K_j = slope_j(y) + h slope_j' sum_l a_jl K_l, solved for all stages at once
        s, m = tableau.coupled, flat.shape[0]
        first = jax.tree.map(lambda g: g[:s], given)
        known = jax.vmap(slope, in_axes=(0, None))(first, flat)
        jacobians = jax.vmap(jax.jacfwd(slope, argnums=1), in_axes=(0, None))(first, flat)
        matrix = jnp.eye(s * m) - h * jnp.einsum("jl,jmk->jmlk", a[:s, :s], jacobians).reshape(s * m, s * m)
        K = jnp.linalg.solve(matrix, known.reshape(-1)).reshape(s, m)
        K = jnp.pad(K, ((0, len(c) - s), (0, 0)))
    else:
        slopes: list[Array] = []
        for j in range(len(c)):
            at_stage = jax.tree.map(lambda g, j=j: g[j], given)
            inside = combine(a[j], slopes)
            slopes.append(slope(at_stage, flat if inside is None else flat + h * inside))
        K = jnp.stack(slopes)
    return jax.vmap(unravel)(flat[None] + h * (a @ K)), unravel(flat + h * (b @ K))


def differentiate(function: Function, t: Array, x: Array, p: Array) -> Slopes:
    """Return the value and the first derivatives of a function of (t, x, p)."""
    D2, D1, Dp = jax.jacfwd(function, argnums=(0, 1, 2))(t, x, p)
    return Slopes(function(t, x, p), D1, D2, Dp)


def differentiate_twice(function: Function, t: Array, x: Array, p: Array) -> Bends:
    """Return the first and second derivatives in x and p of a function of (t, x, p)."""

    def first(t: Array, x: Array, p: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        derivatives = jax.jacfwd(function, argnums=(1, 2))(t, x, p)
        return derivatives, derivatives

    second, (D1, Dp) = jax.jacfwd(first, argnums=(1, 2), has_aux=True)(t, x, p)
    (D1D1, DpD1), (D1Dp, DpDp) = second
    return Bends(D1, Dp, D1D1, DpD1, D1Dp, DpDp)


def contract(psi: Array, second: Array) -> Array:
    """Return ``psi . D^2``: the row vector psi (n,) times the first axis of a (n, ., .) array."""
    return jnp.tensordot(psi, second, 1)


def add(one: State, other: State) -> State:
    """Return the sum of two tuples of arrays."""
    return jax.tree.map(jnp.add, one, other)


def where(condition: Array, one: State, other: State) -> State:
    """Return `one` or `other`, tuples of arrays."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), one, other)


def pick(values: State, index: Array | int | slice) -> State:
    """Return ``values[index]`` of a tuple of arrays."""
    return jax.tree.map(lambda a: a[index], values)


def scatter(values: State, index: Array, added: State) -> State:
    """Return a tuple of arrays with others (K, ...) added at places (K,) of their first axis."""
    return jax.tree.map(lambda a, b: a.at[index].add(b), values, added)


@partial(jax.jit, static_argnames=("structure",))
def evaluate_paper(
    arguments: Arguments, tau: Array, p: Array, side: Array, *, structure: Structure
) -> tuple[Array, Array, Array]:
    """Return J, its gradient (D,) and its Hessian (D, D) of one experiment by `compute_paper_derivatives`."""
    return compute_paper_derivatives(Model(structure, arguments), tau, p, side)
