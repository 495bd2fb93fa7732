"""Which experiment tells most: the search for inputs, sample times and sensors.

The result of an experiment design.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.engine.branches import has_corners
from switchfit.experiment_design.criterion import (
    POWERS,
    SMOOTH,
    Criterion,
    Nominal,
    choose_samples,
    improve_input,
    name_inputs,
    read_limits,
    replace_inputs,
    simulate_values,
    stack_inputs,
)
from switchfit.fit.trajectory import Trajectory, simulate
from switchfit.optimize.threads import one_thread
from switchfit.problem.data import FloatArray, Measurements
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem, require_estimable
from switchfit.problem.validation import (
    as_choice,
    as_count,
    as_index,
    as_instance,
    as_names,
    as_path,
    as_positive,
    as_seed,
    join_names,
    shorten,
)
from switchfit.runtime.files import to_json, write_document
from switchfit.runtime.presentation import Printed, draw_figure, format_line, join_first

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class DesignRecord:
    """What of a design is saved; see `Design`."""

    run: str
    theta_names: tuple[str, ...]
    theta: FloatArray
    names: tuple[str, ...]
    criterion: str
    criterion_before: float
    criterion_after: float
    covariance_before: FloatArray
    covariance: FloatArray
    inputs: dict[str, FloatArray]
    sample_times: dict[str, FloatArray]
    shares: dict[str, FloatArray]
    seconds: float


@dataclass(frozen=True, eq=False)
class Design(DesignRecord, Printed):
    """Result of `design`: an experiment, and how well it will determine the unknowns. Print it for the tables.

    Attributes
    ----------
    run : str
        The run that was designed.
    theta_names : tuple of str, d unknowns of the problem
    theta : (d,)
        At which the information is computed.
    names : tuple of str
        The unknowns that count.
    criterion : {"D", "A", "E"}
    criterion_before, criterion_after : float
        Of the problem as it was given, with all of its samples, and of the design: log det (D), trace (A) or largest
        eigenvalue (E) of the covariance of the unknowns that count, divided by their scales. Infinite where one of them
        cannot be estimated.
    covariance_before, covariance : (d, d)
        Of all unknowns; NaN for those that cannot be estimated.
    inputs : dict of str to (K,) array
        Values of each entry of the input at its knots; empty without an input.
    sample_times : dict of sensor to (K,) array
        Times of the samples, of the sensors that are used.
    shares : dict of sensor to (K,) array
        Share of the information of each sample of `given`. Those of the samples that are taken, of priors and of other
        runs add up to 1; the share of one that is left out says what it would bring.
    seconds : float
    problem : Problem
        With the designed run, ready to simulate and, once its simulated values are replaced by measured ones, to fit.
    given : Problem
        As it was given.
    experiment : int
        Index of the run.

    See Also
    --------
    design

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> plan = sf.design(heater_problem(), samples=4)
    >>> plan.sample_times["thermometer"].shape, plan.undetermined
    ((4,), ())
    """

    problem: Problem
    given: Problem
    experiment: int

    def __repr__(self) -> str:
        change = f"{self.criterion_before:.4g} -> {self.criterion_after:.4g}"
        return format_line(self, self.run, f"{self.criterion} of {join_first(self.names)}: {change}")

    @property
    def standard_errors(self) -> FloatArray:
        """Of all unknowns, with the design: (d,); NaN for those that cannot be estimated."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def standard_errors_before(self) -> FloatArray:
        """Of all unknowns, with the problem as it was given: (d,)."""
        return np.sqrt(np.diag(self.covariance_before))

    @property
    def undetermined(self) -> tuple[str, ...]:
        """The unknowns that the design cannot determine, whatever will be measured."""
        return tuple(np.array(self.theta_names)[np.isnan(self.standard_errors)].tolist())

    @property
    def doubtful(self) -> tuple[str, ...]:
        """The unknowns whose standard error is larger than their distance to a bound or to the next transition: the
        errors of a fit will not be those of a linear model.
        """
        u, errors = self.problem.unknowns, np.nan_to_num(self.standard_errors)
        beyond = (self.theta - errors < u.lower) | (self.theta + errors > u.upper)
        beyond |= np.any(np.abs(u.A) * errors > (u.A @ self.theta - u.b)[:, None], axis=0)
        return tuple(np.array(self.theta_names)[beyond].tolist())

    @cached_property
    def trajectory(self) -> Trajectory:
        """The designed run at `theta`."""
        return simulate(self.problem, self.theta, experiment=self.experiment)

    def plot(self) -> Figure:
        """Draw the input as it was given and as designed, the states, and the share of the information of each sample.

        See Also
        --------
        design

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
        >>> figure = sf.design(heater_problem(), samples=4).plot()
        >>> [ax.get_ylabel() for ax in figure.axes]
        ['T (K)', 'share of information']
        """
        figure: Figure = draw_figure(self)
        return figure

    def save(self, path: str | Path) -> None:
        """Write everything but the problems to a JSON file, atomically.

        Parameters
        ----------
        path : path

        See Also
        --------
        design

        Examples
        --------
        >>> import json
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
        >>> plan = sf.design(heater_problem(), samples=4)
        >>> with TemporaryDirectory() as folder:
        ...     plan.save(Path(folder) / "design.json")
        ...     json.loads((Path(folder) / "design.json").read_text())["design"]["names"]
        ['tau_1', 'k']
        """
        content = {"format": "switchfit design", "version": 1, "design": to_json(self, DesignRecord)}
        write_document(content, as_path(path, "path"))


ROUNDS = 6
"""Most turns of inputs, mesh and samples."""

ENOUGH = 1e-4
"""The turns end where log m falls by less."""

MOST_SENSORS = 12
"""Sensors of which all sets are looked at."""


@one_thread()
def design(
    problem: Problem,
    theta: ArrayLike | None = None,
    *,
    free: Mapping[str, Any] | None = None,
    names: str | Sequence[str] | Mapping[str, float] | None = None,
    criterion: Literal["D", "A", "E"] = "D",
    samples: int | Mapping[str, int] | None = None,
    sensors: int | Mapping[str, float] | None = None,
    budget: float | None = None,
    experiment: int | None = None,
    starts: int = 8,
    seed: int = 0,
) -> Design:
    """Find the experiment that will determine unknowns best: inputs, sample times, sensors.

    Parameters
    ----------
    problem : Problem
        With the planned run: its input and its samples, whose times are the candidates and whose values are not used
        (zeros will do). Sigma must be a number or a parameter. Priors count as information, and so do other runs.
    theta : (d,) array_like, optional
        Values of the unknowns for which the experiment is designed; the initial guess if left out.
    free : mapping of str to (lower, upper), optional
        Inputs whose values at the knots may be changed, and their limits: numbers, or an array with one for each knot.
        An entry of the input is called by its name; "u" if it has none, or "u[0]", "u[1]", ... for several. What is
        constant during a run, such as a dose, can be an input with one knot.
    names : str, sequence of str, or mapping of str to float, optional
        The unknowns that count, such as "mu"; all of them if left out. A mapping has the scale of each, such as the
        standard error that is wanted, by which it is divided.
    criterion : {"D", "A", "E"}, optional
        What of their covariance is made small: the determinant, that is the volume of the confidence ellipsoid; the
        trace, that is the sum of variances; the largest eigenvalue. A and E depend on units, or on the scales.
    samples : int or mapping of sensor to int, optional
        Most sample times of each sensor, chosen among those of the problem; all of them if left out.
    sensors : int or mapping of sensor to float, optional
        Most `Measurements` of the run that are used, or what each costs; all are used if left out. A sensor is called
        by the names of its channels, such as "X, Y".
    budget : float, optional
        Most that the sensors may cost together.
    experiment : int, optional
        Index of the run that is designed, from 0; the last one if left out.
    starts : int, optional
        How many inputs at random the search begins from, beside the given one.
    seed : int, optional
        Of these.

    Returns
    -------
    Design

    Raises
    ------
    ValueError
        For data that are no `Measurements` or have no sigma; limits, names and numbers that do not fit; a free input in
        a problem with guards, or with corners of the state in the run; transition times that do not meet guards.
    TypeError
        If an argument is of the wrong type.

    Notes
    -----
    The information is ``sum C' C / sigma**2``, with the sensitivities C of all samples at theta, plus the inverse
    variances of priors. Inputs are found by L-BFGS-B with the exact gradient: a local optimum, the best of all starts.
    Samples and sensors are found by an exchange algorithm, in turns with the inputs.

    See Also
    --------
    Design, identifiability, monte_carlo

    Examples
    --------
    Four measurements instead of 24, those that tell most about the cooling k and the end of heating tau_1:

    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> plan = sf.design(heater_problem(), samples=4)
    >>> plan.sample_times["thermometer"]
    array([1.75, 2.  , 2.25, 3.75])

    >>> plan.standard_errors_before.round(3), plan.standard_errors.round(3)
    (array([0.02 , 0.008]), array([0.027, 0.014]))
    """
    began = time.perf_counter()
    as_instance(problem, "problem", Problem, "an sf.Problem")
    require_estimable(problem)
    last = len(problem.experiments) - 1
    e = last if experiment is None else as_index(experiment, "experiment", last + 1)
    nominal, kind = problem.check_theta(theta), as_choice(criterion, "criterion", tuple(POWERS))
    starts, seed = as_count(starts, "starts"), as_seed(seed)
    _check_data(problem)
    run, (chosen, scales) = problem.experiments[e], _find_chosen(problem, names)
    labels = name_sensors(run)
    most = _list_limits(run, labels, samples, sensors, budget)
    lower, upper = read_limits(run, {} if free is None else free)
    if free and (problem.constraint_names or has_corners(problem.structures[e])):
        raise ValueError(
            "free cannot be used where transitions have guards, or modes have corners of the state (as jnp.sign of a "
            "state has): choose samples and sensors alone, and compare inputs by a call for each."
        )
    every = taken = [np.ones(len(item.times), dtype=bool) for item in run.data]
    before = here = Nominal(simulate_values(problem, e, nominal, every), e, nominal)
    rule, power = _build_criterion(before, chosen, scales), POWERS[kind]
    begin = [stack_inputs(run), *np.random.default_rng(seed).uniform(lower, upper, (starts, *lower.shape))]
    best, lowest = here, np.inf
    for _ in range(ROUNDS if free else 1):
        if free:
            begin = [improve_input(here, rule, min(power, SMOOTH), taken, (lower, upper), begin)]
            changed = replace_inputs(before.problem, e, begin[0])
            here = Nominal(simulate_values(changed, e, nominal, every), e, nominal)
        value, chosen_samples = choose_samples(here.candidates, most, lambda F: rule.rate(F, power)[0])
        gain = lowest - value
        if gain > 0:
            best, lowest = here, value
            taken = np.split(chosen_samples, np.cumsum([len(each) for each in every])[:-1])
        if gain < ENOUGH:
            break
    planned = Nominal(simulate_values(best.problem, e, best.theta, taken), e, best.theta)
    slope = rule.rate(best.candidates.add(np.concatenate(taken)), power)[1]
    shares = -np.einsum("de,kde->k", slope, best.candidates.information)
    return Design(
        run=problem.run_names[e],
        theta_names=problem.theta_names,
        theta=planned.theta,
        names=tuple(problem.theta_names[k] for k in chosen),
        criterion=kind,
        criterion_before=rule.measure(kind, before.covariance),
        criterion_after=rule.measure(kind, planned.covariance),
        covariance_before=before.covariance,
        covariance=planned.covariance,
        inputs=dict(zip(name_inputs(run), stack_inputs(planned.problem.experiments[e]).T, strict=True)),
        sample_times={
            label: item.times[own] for label, item, own in zip(labels, run.data, taken, strict=True) if own.any()
        },
        shares={label: shares[best.candidates.sensor == s] for s, label in enumerate(labels)},
        seconds=time.perf_counter() - began,
        problem=planned.problem,
        given=problem,
        experiment=e,
    )


def name_sensors(run: Experiment) -> tuple[str, ...]:
    """Return what each of the `Measurements` of a run is called: the names of its channels, or sensor 1, 2, ...

    Parameters
    ----------
    run : Experiment
    """
    names = [", ".join(item.names or ()) or f"sensor {k}" for k, item in enumerate(run.data, start=1)]
    return tuple(f"{name} ({k})" if names.count(name) > 1 else name for k, name in enumerate(names, start=1))


def _check_data(problem: Problem) -> None:
    """Raise ValueError unless all data are `Measurements` with sigma: their information does not depend on values."""
    for name, run in zip(problem.run_names, problem.experiments, strict=True):
        for item in run.data:
            if not isinstance(item, Measurements):
                raise ValueError(f"design needs Measurements, for the data of {name}; got {shorten(item)}.")
            if item.sigma is None:
                raise ValueError(f"design needs sigma, the standard deviation of the noise, for the data of {name}.")


def _find_chosen(problem: Problem, names: Any) -> tuple[NDArray[np.intp], FloatArray]:
    """Return the positions in theta of the unknowns that count, and their scales: (s,) each."""
    known, spans = list(problem.theta_names), problem.unknowns.parameters
    given = known if names is None else [names] if isinstance(names, str) else names
    scaled = given if isinstance(given, Mapping) else dict.fromkeys(as_names(given, "names", "names of unknowns"), 1.0)
    found: dict[int, float] = {}
    for name, scale in scaled.items():
        if name not in known and name not in spans:
            raise ValueError(f"names has {shorten(name)}, which is no unknown of the problem: {join_names(known)}.")
        places = [known.index(name)] if name in known else range(len(known))[spans[name]]
        found |= dict.fromkeys(places, as_positive(scale, f"scale of {name}"))
    if not found:
        raise ValueError("names is empty: name the unknowns that count, or leave it out for all.")
    return np.array(list(found), dtype=np.intp), np.array(list(found.values()))


def _build_criterion(before: Nominal, chosen: NDArray[np.intp], scales: FloatArray) -> Criterion:
    """Return the criterion, with typical standard errors from the information of the problem as it was given."""
    diagonal = np.diag(before.basis.T @ before.information @ before.basis)
    return Criterion(chosen, scales, before.basis, 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)))


def _list_limits(
    run: Experiment, labels: tuple[str, ...], samples: Any, sensors: Any, budget: float | None
) -> list[NDArray[np.intp]]:
    """Return the most samples of each sensor, (S,), for each largest set of sensors that number or costs allow."""
    counts = samples if isinstance(samples, Mapping) else dict.fromkeys(labels, samples)
    costs = sensors if isinstance(sensors, Mapping) else dict.fromkeys(labels, 1.0)
    for what, given in (("samples", counts), ("sensors", costs)):
        if unknown := [name for name in given if name not in labels]:
            raise ValueError(f"{what} names {shorten(unknown[0])}; the sensors are {join_names(labels)}.")
    if (budget is None) == isinstance(sensors, Mapping):
        raise ValueError("budget and the costs of sensors belong together: give sensors={name: cost} and budget.")
    whole = np.array([len(item.times) for item in run.data])
    for s, name in enumerate(labels):
        if counts.get(name) is not None:
            whole[s] = min(whole[s], as_count(counts[name], f"samples of {name}", at_least=1))
    if sensors is None:
        return [whole]
    if len(labels) > MOST_SENSORS:
        raise ValueError(f"sensors can be chosen among {MOST_SENSORS}; there are {len(labels)}.")
    prices = np.array([as_positive(costs[name], f"cost of {name}") if name in costs else 0.0 for name in labels])
    most = as_count(sensors, "sensors", at_least=1) if budget is None else as_positive(budget, "budget")
    every = np.array(list(product((0, 1), repeat=len(labels))))
    allowed = every[every @ prices <= most]
    largest = [own for own in allowed if not any(np.all(other >= own) and np.any(other > own) for other in allowed)]
    if not np.any(largest):
        raise ValueError(f"no sensor is within the budget of {most:g}; got costs {shorten(dict(costs))}.")
    return [whole * own for own in largest]
