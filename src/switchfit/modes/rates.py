"""The insertion rate: the derivative of J in the length of a pulse of another mode.

A pulse of mode k that begins at t, in a segment of mode m, changes the state behind it by
``length (f_k(t, x) - f_m(t, x))``. With the costate psi(t) of the backward sweep, the derivative of J in its length is
at length zero ([1]_, [2]_)

    d(k, t) = psi(t) . (f_k(t, x(t)) - f_m(t, x(t))).

One backward sweep has the costates at all rows, so that the rates of all modes at all rows take little more time than
one gradient. Running costs, samples, terminal costs, reset maps and costs at the transitions that are there reach the
rate by the costate. Where there are guards or terminal constraints, the costate is that of the Lagrangian.

References
----------
.. [1] M. Egerstedt, Y. Wardi, H. Axelsson, Transition-time optimization for switched-mode dynamical systems, IEEE
   Trans. Automat. Contr. 51 (2006) 110-115.
.. [2] H. Axelsson, Y. Wardi, M. Egerstedt, E. I. Verriest, Gradient descent approach to optimal mode scheduling in
   hybrid dynamical systems, J. Optim. Theory Appl. 136 (2008) 167-186.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.arrays import FloatArray
from switchfit.engine.simulation import Costates
from switchfit.fit.comparison import compare
from switchfit.fit.trajectory import Trajectory
from switchfit.meshes.evaluator import Evaluator
from switchfit.problem.problem import Problem
from switchfit.problem.system import HybridSystem
from switchfit.problem.validation.arrays import as_count
from switchfit.problem.validation.objects import as_instance
from switchfit.runtime.presentation import Axes, Figure, Printed, draw_figure, format_line


class Pulse(NamedTuple):
    """A pulse of length zero that lowers J: its mode, the time at which it begins, and dJ/d(length)."""

    mode: str
    time: float
    rate: float


@dataclass(frozen=True, eq=False)
class Insertion(Printed):
    """Derivative of J in the length of a pulse of each mode, at the starts of all rows of the mesh.

    Attributes
    ----------
    times : (R,) array
        When a pulse begins, in the experiment's time unit: all nodes of the mesh but the last, and the transitions. A
        sample at that time lies before the pulse.
    modes : tuple of str, length K
        All modes of the system.
    rate : (R, K) array
        dJ/d(length) at length zero; 0 for the mode that is active anyway. NaN where it is not defined: a pulse between
        two segments of the active mode would begin or end with a reset map, which changes the state by a finite
        amount, or with a guard, which decides when it may begin or end.
    active : (R,) array of int
        The mode that a pulse interrupts, as index into `modes`.
    trajectory : Trajectory
        What is interrupted.
    name : str
        Of the experiment.

    See Also
    --------
    insertion

    Examples
    --------
    >>> rate = sf.insertion(heater_problem())
    >>> rate.modes, rate.rate.shape == (len(rate.times), 2)
    (('on', 'off'), True)
    """

    times: FloatArray
    modes: tuple[str, ...]
    rate: FloatArray
    active: NDArray[np.intp]
    trajectory: Trajectory
    name: str

    def __repr__(self) -> str:
        best = self.best()
        lowest = "no pulse lowers J" if best is None else f"best {best[0]} at {best[1]:.6g}"
        return format_line(self, self.name, f"{len(self.times)} times", f"{len(self.modes)} modes", lowest)

    def best(self) -> tuple[str, float] | None:
        """Return the mode and the time of the pulse with the lowest rate; None if no pulse lowers J.

        See Also
        --------
        Insertion.minima

        Examples
        --------
        >>> mode, time = sf.insertion(heater_problem()).best()
        >>> mode, 2.0 <= time <= 3.0
        ('on', True)
        """
        lowest = self.minima(1)
        return (lowest[0].mode, lowest[0].time) if lowest else None

    def minima(self, count: int = 3) -> list[Pulse]:
        """Return the lowest local minima of each mode's rate over time that are below zero, the lowest first.

        Parameters
        ----------
        count : int, optional
            How many of each mode.

        See Also
        --------
        Insertion.best

        Examples
        --------
        >>> pulses = sf.insertion(heater_problem()).minima()
        >>> all(pulse.rate < 0 for pulse in pulses)
        True
        """
        count = as_count(count, "count")
        found: list[Pulse] = []
        for mode, rate in zip(self.modes, self.rate.T, strict=True):
            known = np.where(np.isfinite(rate), rate, np.inf)
            before, after = np.append(np.inf, known[:-1]), np.append(known[1:], np.inf)
            # Of a plateau the last place counts, once.
            places = np.flatnonzero((known < 0.0) & (known <= before) & (known < after))
            lowest = places[np.argsort(known[places], kind="stable")][:count]
            found += [Pulse(mode, float(self.times[r]), float(known[r])) for r in lowest.tolist()]
        return sorted(found, key=lambda pulse: pulse.rate)

    def plot(self, *, ax: Axes | None = None) -> Axes | Figure:
        """Draw the rate of each mode over time, with the modes that are active shaded.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional

        Returns
        -------
        matplotlib.axes.Axes or matplotlib.figure.Figure
            The axes that were given; without any, a new figure.

        See Also
        --------
        insertion

        Examples
        --------
        >>> figure = sf.insertion(heater_problem()).plot()
        >>> figure.axes[0].get_ylabel()
        'dJ / d length of a pulse (1/h)'
        """
        return draw_figure(self, ax=ax)


def insertion(problem: Problem, theta: ArrayLike | None = None) -> Insertion | tuple[Insertion, ...]:
    """Compute how J changes with the length of a pulse of any mode, at any time, where there is none yet.

    Where the rate is below zero, a short pulse of that mode lowers J: the mode sequence lacks a mode there. Rates of
    zero or above everywhere say that no additional short pulse does; a mode that is missing for long may still lower
    J.

    Parameters
    ----------
    problem : Problem
        All modes of its system are considered, also those that its mode sequences lack.
    theta : (d,) array_like, optional
        In the order of ``problem.theta_names``; the initial guess if left out.

    Returns
    -------
    Insertion, or a tuple of them, one for each experiment, if there are several

    Raises
    ------
    ValueError
        For a theta of the wrong shape or with transition times out of order.
    TypeError
        If an argument is of the wrong type.

    Notes
    -----
    The rate is ``psi(t) . (f_k - f_m)``, with the costate psi of the discretized system and the mode m that is active
    at t: it differs by the integration error from the derivative of J in the second of two equal transition times,
    between which a mode k lasts for no time. A `TransitionCost` of the two additional transitions is not included: J
    rises by it however short the pulse. With guards or terminal constraints, the rate is that of
    ``J + multipliers . c``, with the multipliers of least squares, ``min |gradient + multipliers . jacobian|``, which
    are those of a solution if theta is one.

    The evaluation takes as long as that of J with its gradient and Hessian.

    See Also
    --------
    Insertion, evaluate

    Examples
    --------
    A run that was fitted without the mode in its middle:

    >>> system = sf.HybridSystem({"rest": lambda t, x, p: 0.0 * x, "rise": lambda t, x, p: 0.0 * x + 1.0}, [0.0])
    >>> times = np.linspace(0.0, 10.0, 21)
    >>> log = sf.Measurements(times, np.clip(times - 4.0, 0.0, 2.0), sigma=0.1)
    >>> problem = sf.Problem(system, sf.Experiment(log, ("rest",), (), 0.0), {"unused": 1.0})
    >>> mode, time = sf.insertion(problem).best()
    >>> mode, 4.0 <= time <= 6.0
    ('rise', True)
    """
    as_instance(problem, "problem", Problem, "an sf.Problem")
    checked = problem.check_theta(theta)
    found = compute_rates(Evaluator(add_all_modes(problem), checked), checked)
    return found[0] if len(found) == 1 else found


def add_all_modes(problem: Problem) -> Problem:
    """Return the problem with a library of all modes of its system, so that engines have their vector fields."""
    if problem.max_transitions is not None:
        return problem
    most = max(max(len(run.transition_times), 1) + len(run.jump_times) for run in problem.experiments)
    return replace(problem, max_transitions=most)


def compute_rates(evaluator: Evaluator, theta: FloatArray) -> tuple[Insertion, ...]:
    """Return the insertion rates of each experiment at theta (d,); the problem must have `max_transitions`."""
    problem = evaluator.problem
    # At a minimum these are the optimiser's; elsewhere the nearest that there are.
    multipliers = np.split(_estimate_multipliers(evaluator, theta), np.cumsum(problem.constraint_counts)[:-1])
    trajectories, _ = compare(evaluator, theta)
    found = []
    for e, (engine, name) in enumerate(zip(evaluator.engines, problem.run_names, strict=True)):
        tau, p = problem.vectors(theta, e)
        rows = engine.costates(tau, p, multipliers[e])
        slopes = engine.slopes(rows.times, rows.cells, rows.states, p)
        rate = _rate_pulses(problem.system, rows, slopes)
        found.append(Insertion(rows.times, tuple(problem.system.modes), rate, rows.modes, trajectories[e], name))
    return tuple(found)


def _rate_pulses(system: HybridSystem, rows: Costates, slopes: FloatArray) -> FloatArray:
    """Return ``psi . (f_k - f_m)`` at the starts of rows, NaN where a pulse is no small change: (R, K)."""
    names = tuple(system.modes)
    # Vector fields of all modes at each row's start, of which the active one is taken away.
    active = slopes[np.arange(len(slopes)), rows.modes]
    with np.errstate(all="ignore"):  # a mode may not be defined at states where it never is active
        rate = np.einsum("rn,rkn->rk", rows.costates, slopes[:, : len(names)] - active[:, None])
    # A reset map changes the state by a finite amount however short the pulse is, and a guard decides when it begins.
    special = {*system.reset_maps, *system.guards}
    defined = np.array([[not {(m, k), (k, m)} & special for k in names] for m in names])
    rate[~defined[rows.modes]] = np.nan
    rate[np.arange(len(rate)), rows.modes] = 0.0
    return rate


def _estimate_multipliers(evaluator: Evaluator, theta: FloatArray) -> FloatArray:
    """Return the multipliers (m,) of all constraints that minimize ``|gradient + multipliers . jacobian|``."""
    if not evaluator.problem.constraint_names:
        return np.zeros(0)
    found = evaluator.constrained(theta)
    return np.asarray(np.linalg.lstsq(found.jacobian.T, -found.gradient, rcond=None)[0], dtype=np.float64)
