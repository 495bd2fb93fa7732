"""Which combinations of the unknowns the data determine badly, in words and with their size, and whether that is so.

The Hessian scaled to unit curvature of each unknown, ``S H S`` with ``S = diag(H)^(-1/2)``, does not know the units:
its eigenvalues would all be 1 if every unknown were determined independently of the others. An eigenvector v with a
small eigenvalue lambda is a combination that the data hardly see: J rises by lambda / 2 a unit of length along ``S v``.

The statement "tau_2 later and mu lower leaves J as it is" is made with a length at which the quadratic form says that
J rises by `Identifiability.rise`, and J is evaluated there on both sides: what is printed is what was found. Where
that is more than twice of what was predicted, since the valley bends, the length is halved until it is not.

Before a fit the same is done with data as the first guess itself would produce them, without noise: there the cost is
0, its gradient vanishes, and its exact Hessian is the Gauss-Newton matrix (the expected information).
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.special

from switchfit.fit.evaluator import Evaluator, evaluator_of
from switchfit.fit.hidden import refuse_hidden_switches
from switchfit.fit.result import Fit, scaled_spectrum
from switchfit.fit.solution import least_squares
from switchfit.fit.trajectory import compare
from switchfit.problem.data import FloatArray, Measurements
from switchfit.problem.problem import Problem

WEAK = 0.05
"""Scaled eigenvalues below this are told: standard errors along them are 4.5 times those of each unknown alone."""
MOST = 3
"""Directions that are told."""
NAMED = 0.2
"""Unknowns with less than this part of the largest weight in a direction are not named."""
UNDETERMINED = 1e-10
"""Scaled eigenvalues below this are zero."""
HALVINGS = 20
WIDTH = 100
HIDDEN, ONE_PERCENT = "noise hides {} (95 %)", "1 % of J is {}"


@dataclass(frozen=True, eq=False)
class Direction:
    """A combination of the unknowns, and what was found along it.

    Attributes
    ----------
    eigenvalue : float
        Of the Hessian scaled to unit curvature of each unknown.
    weights : (d,)
        Its eigenvector, in scaled unknowns, the largest entry positive.
    change : (d,)
        The change of theta that was tried, a multiple of the scaled eigenvector, in units.
    rises : (float, float)
        By how much J rises at theta + change and at theta - change; NaN where that is not allowed.
    summary : str
        "tau_2 and mu trade off".
    sentence : str
        The same with the change, and what was found.
    """

    eigenvalue: float
    weights: FloatArray
    change: FloatArray
    rises: tuple[float, float]
    summary: str
    sentence: str


@dataclass(frozen=True, eq=False)
class Identifiability:
    """How well data determine the unknowns; print it.

    Attributes
    ----------
    theta_names : tuple of str
    eigenvalues : (k,)
        Ascending, of the Hessian scaled to unit curvature of each unknown, on the directions that nothing holds.
    vectors : (d, k)
        Their eigenvectors in scaled unknowns.
    without : tuple of str
        Unknowns on which the cost does not depend at all, to second order.
    held : tuple of str
        Unknowns that a constraint, a kink or a collapsed mode holds, of which nothing is said.
    directions : tuple of Direction
        The badly determined ones, at most three, and the worst one at any rate.
    rise : float
        Of J, for which the changes are chosen.
    meaning : str
        What that rise is, with {} where its size belongs.
    where : str
    idle : tuple of str
        Unknowns on which the cost does not depend because modes have collapsed, as in `Fit.idle`.
    """

    theta_names: tuple[str, ...]
    eigenvalues: FloatArray
    vectors: FloatArray
    without: tuple[str, ...]
    held: tuple[str, ...]
    directions: tuple[Direction, ...]
    rise: float
    meaning: str
    where: str
    idle: tuple[str, ...] = ()

    @property
    def condition_number(self) -> float:
        """Of the scaled Hessian; infinite where it is singular."""
        if not len(self.eigenvalues) or self.without or self.eigenvalues[0] <= UNDETERMINED:
            return np.inf if len(self.eigenvalues) or self.without else np.nan
        return float(self.eigenvalues[-1] / self.eigenvalues[0])

    @property
    def undetermined(self) -> int:
        """Number of combinations that the data do not determine at all."""
        return len(self.without) + int(np.sum(self.eigenvalues < UNDETERMINED))

    def __str__(self) -> str:
        count = len(self.theta_names) - len(self.held)
        lines = []
        if self.without:
            lines.append(f"{self.where} the cost does not depend on {', '.join(self.without)}, to second order.")
        if self.idle:
            lines.append(
                f"{self.where} the cost does not depend on {', '.join(self.idle)}, because a mode has collapsed: leave "
                "it out of mode_sequence."
            )
        if not count:
            lines.append(f"{self.where} constraints, kinks and collapsed modes hold all unknowns.")
            return "\n".join(part for line in lines for part in textwrap.wrap(line, WIDTH))
        if self.undetermined == 0:
            lines.append(
                f"{self.where} the data determine all {count} unknowns; condition number of the scaled Hessian "
                f"{self.condition_number:.3g}."
            )
        elif self.undetermined > len(self.without):
            many = self.undetermined - len(self.without)
            what = "one combination" if many == 1 else f"{many} combinations"
            lines.append(f"{self.where} the data do not determine {what} of the {count} unknowns.")
        shown = [part for line in lines for part in textwrap.wrap(line, WIDTH)]
        for direction in self.directions:
            shown += textwrap.wrap(direction.sentence, WIDTH, initial_indent="  - ", subsequent_indent="    ")
        return "\n".join(shown)


def identifiability(subject: Any) -> Identifiability:
    """How well the data determine the unknowns, at the solution of a fit or, before any fit, at the first guess.

    Parameters
    ----------
    subject : Estimate or Problem

    Returns
    -------
    Identifiability

    Raises
    ------
    TypeError
        For anything else.
    ValueError
        If a parameter of the problem changes the cost while its derivative is zero: a switch hidden in a function.
    """
    if isinstance(subject, Problem):
        return _before(subject)
    if isinstance(subject, Fit):
        fit: Any = subject
        return after(fit, None if fit.problem is None else fit.evaluator_at_solution())
    raise TypeError(f"identifiability needs an sf.Estimate or an sf.Problem; got {type(subject).__name__}.")


def after(fit: Fit, evaluator: Evaluator | None) -> Identifiability:
    """At the solution of a fit; without an evaluator nothing is tried.

    Parameters
    ----------
    fit : Fit
    evaluator : Evaluator or None
    """
    if fit.sigma_known is None:
        rise, meaning = 0.01 * abs(fit.cost), ONE_PERCENT
    else:
        scale = fit.residual_variance if fit.sigma_known is False and fit.freedom > 0 else 1.0
        rise, meaning = 0.5 * scale * fit.quantile(0.95) ** 2, HIDDEN
    cost = None if evaluator is None else lambda theta: evaluator(theta).cost
    found = analyse(
        fit.hessian,
        fit.free_basis,
        fit.theta,
        fit.theta_names,
        fit.theta_units,
        cost,
        rise,
        meaning,
        "At the solution",
        allowed=None if evaluator is None else _allowed(evaluator.problem),
        base=fit.cost,
    )
    return replace(found, idle=fit.idle)


def _before(problem: Problem) -> Identifiability:
    """At the first guess, with the data that it would itself produce, where they are Measurements."""
    theta, unknowns = problem.initial_theta, problem.unknowns
    own = evaluator_of(problem)
    refuse_hidden_switches(own, theta, own(theta).gradient)
    items = [item for run in problem.experiments for item in run.data]
    if all(isinstance(item, Measurements) for item in items):
        clean = _noise_free(problem, own)
        evaluator = Evaluator(clean, meshes=own.meshes)
        # Where sigma is a parameter J has no minimum without noise; its expected Hessian is Gauss-Newton's.
        hessian = evaluator(theta, matrix="exact" if least_squares(problem) else "gauss-newton").hessian
        if all(item.sigma is not None for item in items):
            rise, meaning = 0.5 * float(scipy.special.ndtri(0.975)) ** 2, HIDDEN
        else:
            rise, meaning = 1e-4 * _variation(clean), "a change of all that is measured by 1 % of how it varies does {}"
        base = np.nan
    else:
        evaluator = own
        here = own(theta, matrix="gauss-newton")
        hessian, base = here.hessian, here.cost
        rise, meaning = 0.01 * abs(here.cost), ONE_PERCENT
    return analyse(
        hessian,
        np.eye(len(theta)),
        theta,
        unknowns.names,
        unknowns.units,
        lambda at: evaluator(at).cost,
        rise,
        meaning,
        "At the first guess",
        allowed=_allowed(problem),
        base=base,
    )


def _noise_free(problem: Problem, evaluator: Evaluator) -> Problem:
    """The problem with the values that its first guess produces; missing ones stay missing."""
    theta = problem.initial_theta
    comparisons = compare(problem, theta, evaluator.simulate(theta))[1]
    experiments = []
    for experiment, found in zip(problem.experiments, comparisons, strict=True):
        data = [
            replace(item, values=np.where(np.isnan(item.values), np.nan, comparison.fitted))
            for item, comparison in zip(experiment.data, found, strict=True)
        ]
        experiments.append(replace(experiment, data=data))
    return replace(problem, experiments=experiments)


def _variation(problem: Problem) -> float:
    """Half the weighted sum of squares of what is measured about its mean, channel by channel."""
    total = 0.0
    for experiment in problem.experiments:
        for item in experiment.data:
            weights = item.weights
            values = np.nan_to_num(item.values)
            mean = (weights * values).sum(0) / np.maximum(weights.sum(0), 1e-300)
            total += 0.5 * float(np.sum(weights * (values - mean) ** 2))
    return total


def _allowed(problem: Problem) -> Callable[[FloatArray], bool]:
    u = problem.unknowns

    def allowed(theta: FloatArray) -> bool:
        return bool(np.all(theta >= u.lower) and np.all(theta <= u.upper) and np.all(u.A @ theta >= u.b))

    return allowed


def analyse(
    hessian: FloatArray,
    basis: FloatArray,
    theta: FloatArray,
    names: tuple[str, ...],
    units: tuple[str, ...],
    cost: Callable[[FloatArray], float] | None,
    rise: float,
    meaning: str,
    where: str,
    *,
    allowed: Callable[[FloatArray], bool] | None = None,
    base: float = np.nan,
) -> Identifiability:
    """The badly determined directions of a Hessian, tried out with the cost it belongs to.

    Parameters
    ----------
    hessian : (d, d)
    basis : (d, k)
        Orthonormal basis of the directions that nothing holds.
    theta : (d,)
    names, units : tuple of str
    cost : callable ``theta -> J``, or None
        None: nothing is tried.
    rise : float
        Of J, for which changes of theta are chosen.
    meaning : str
        What that rise is, with {} where its size belongs.
    where : str
        "At the solution", to begin sentences with.
    allowed : callable ``theta -> bool``, optional
        Whether theta satisfies the constraints.
    base : float, optional
        J, to which a rise is related; NaN if it should not be.
    """
    free = np.abs(basis).max(1, initial=0.0) > 1e-9
    held = tuple(n for n, f in zip(names, free, strict=True) if not f)
    if not free.any() or not np.isfinite(hessian).all():
        return Identifiability(names, np.zeros(0), np.zeros((len(names), 0)), (), held, (), rise, meaning, where)
    flat = np.all(hessian == 0.0, axis=1).tolist()
    without = tuple(n for n, f, nothing in zip(names, free, flat, strict=True) if f and nothing)
    spectrum = scaled_spectrum(hessian, basis)
    values, vectors = spectrum.values, spectrum.vectors
    # What the cost does not depend on at all is told by itself.
    dead = np.array([n in without for n in names])
    kept = [k for k in range(len(values)) if not np.sum(vectors[dead, k] ** 2) > 0.5]
    values, vectors = values[kept], vectors[:, kept]
    weak = [k for k in range(len(values)) if values[k] < WEAK][:MOST] or list(range(min(1, len(values))))
    directions = []
    for k in weak:
        v = vectors[:, k]
        v = v * np.sign(v[np.argmax(np.abs(v))])
        change, rises = _tried(spectrum.size * v, float(values[k]), theta, cost, rise, allowed)
        told = meaning.format(f"{rise:.2g}") if rise > 0 else ""
        strong = [i for i in np.argsort(-np.abs(v), kind="stable") if abs(v[i]) > NAMED * np.abs(v).max()]
        who = f"{_and([names[i] for i in strong])} trade off" if len(strong) > 1 else f"{names[strong[0]]} by itself"
        # A change that is told as its opposite where only that side is allowed.
        side = -1.0 if np.isnan(rises[0]) and np.isfinite(rises[1]) else 1.0
        moves = _and([_moved(names[i], units[i], side * change[i]) for i in strong])
        found = _found(rises, told, base) if cost is not None else f", or the opposite, should raise J little; {told}."
        sentence = f"{who} (scaled eigenvalue {values[k]:.2g}): {moves}{found}"
        directions.append(Direction(float(values[k]), v, change, rises, who, sentence))
    return Identifiability(names, values, vectors, without, held, tuple(directions), rise, meaning, where)


def _tried(
    direction: FloatArray,
    eigenvalue: float,
    theta: FloatArray,
    cost: Callable[[FloatArray], float] | None,
    rise: float,
    allowed: Callable[[FloatArray], bool] | None,
) -> tuple[FloatArray, tuple[float, float]]:
    """The change along a direction (d,) at which J should rise by `rise`, and by how much it does on both sides."""
    known = theta != 0
    # No unknown moves by more than its own size, where it has one.
    share = np.max(np.abs(direction[known] / theta[known]), initial=0.0)
    reach = 1.0 / float(share or np.max(np.abs(direction)))
    length = min(np.sqrt(2 * rise / eigenvalue), reach) if eigenvalue > 0 else reach
    change = length * direction
    if cost is None or not rise > 0:
        return change, (np.nan, np.nan)
    here = cost(theta)
    rises = (np.nan, np.nan)
    for _ in range(HALVINGS):
        rises = tuple(  # type: ignore[assignment]  # two
            cost(theta + s * change) - here if allowed is None or allowed(theta + s * change) else np.nan
            for s in (1.0, -1.0)
        )
        finite = [r for r in rises if np.isfinite(r)]
        if finite and max(finite) <= 2 * rise:
            break
        change = 0.5 * change
    return change, rises


def _found(rises: tuple[float, float], told: str, base: float) -> str:
    """What was found on both sides of a change, the end of a sentence."""
    finite = [r for r in rises if np.isfinite(r)]
    if not finite:
        return ": J could not be evaluated there."
    worst = max(finite)
    related = np.isfinite(base) and abs(worst) < 10 * abs(base)  # of a J near 0 nothing is a part
    relative = f" ({100 * worst / abs(base):.2g} %)" if related else ""
    both = ", or the opposite," if len(finite) == 2 else ""
    return f"{both} raises J by {worst:.2g}{relative}" + (f"; {told}." if told else ".")


def _moved(name: str, unit: str, change: float) -> str:
    """A change in words: later or earlier for a transition time, higher or lower for anything else."""
    is_time = name.rpartition(".")[2].startswith("tau_")
    word = ("later" if change > 0 else "earlier") if is_time else ("higher" if change > 0 else "lower")
    shown = "" if unit in ("", "1") else f" {unit}"
    return f"{name} {abs(change):.2g}{shown} {word}"


def _and(parts: list[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
