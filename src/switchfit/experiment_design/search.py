"""The search for the experiment that determines unknowns best: inputs and samples in turns.

Inputs are improved for the samples that are taken, then samples are chosen for these inputs, until that gains nothing.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.arrays import FloatArray
from switchfit.engine.corners.branches import has_corners
from switchfit.experiment_design.criterion import POWERS, Criterion
from switchfit.experiment_design.input_search import LARGEST_SMOOTH_POWER, improve_input
from switchfit.experiment_design.inputs import name_inputs, read_limits, replace_inputs, stack_inputs
from switchfit.experiment_design.nominal import Nominal, simulate_values
from switchfit.experiment_design.result import Design
from switchfit.experiment_design.samples import choose_samples
from switchfit.experiment_design.sensors import list_sample_limits, name_sensors
from switchfit.optimize.threads import one_thread
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem, require_estimable
from switchfit.problem.validation import arrays, objects
from switchfit.problem.validation import names as names_module
from switchfit.problem.validation.arrays import as_count, as_positive
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.problem.validation.names import as_names

MOST_TURNS = 6
"""Most turns of inputs, mesh and samples."""

LEAST_GAIN_OF_TURN = 1e-4
"""The turns end where log m falls by less."""


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

    >>> plan = sf.design(heater_problem(), samples=4)
    >>> plan.sample_times["thermometer"]
    array([1.75, 2.  , 2.25, 3.75])

    >>> plan.standard_errors_before.round(3), plan.standard_errors.round(3)
    (array([0.02 , 0.008]), array([0.027, 0.014]))
    """
    began = time.perf_counter()
    objects.as_instance(problem, "problem", Problem, "an sf.Problem")
    require_estimable(problem)
    last = len(problem.experiments) - 1
    e = last if experiment is None else arrays.as_index(experiment, "experiment", last + 1)
    nominal, kind = problem.check_theta(theta), names_module.as_choice(criterion, "criterion", tuple(POWERS))
    starts, seed = as_count(starts, "starts"), arrays.as_seed(seed)
    _check_data(problem)
    run, (chosen, scales) = problem.experiments[e], _find_chosen(problem, names)
    labels = name_sensors(run)
    most = list_sample_limits(run, labels, samples, sensors, budget)
    lower, upper = read_limits(run, {} if free is None else free)
    if free and (problem.constraint_names or has_corners(problem.structures[e])):
        raise ValueError(
            "free cannot be used where transitions have guards, or modes have corners of the state (as jnp.sign of a "
            "state has): choose samples and sensors alone, and compare inputs by a call for each."
        )
    # Everything is measured at first; a choice of samples follows inputs that were good for all of them.
    every = taken = [np.ones(len(item.times), dtype=bool) for item in run.data]
    before = here = Nominal(simulate_values(problem, e, nominal, every), e, nominal)
    # Scaled by the problem as it was given, so that all designs of one search are rated by the same ridge.
    rule, power = _build_criterion(before, chosen, scales), POWERS[kind]
    # The given input is among the starts: a design is never worse than it, for these samples.
    begin = [stack_inputs(run), *np.random.default_rng(seed).uniform(lower, upper, (starts, *lower.shape))]
    best, lowest = here, np.inf
    # Without free inputs one choice of samples is all: a second turn would rate the same candidates.
    for _ in range(MOST_TURNS if free else 1):
        if free:
            # Only the first turn has many starts; later ones go on from the best input.
            begin = [improve_input(here, rule, min(power, LARGEST_SMOOTH_POWER), taken, (lower, upper), begin)]
            # A mesh of its own for the new input: its steps were chosen for the old one.
            changed = replace_inputs(before.problem, e, begin[0])
            here = Nominal(simulate_values(changed, e, nominal, every), e, nominal)
        # Each largest set of sensors by itself: exchanges do not lead from one to another.
        choices = (choose_samples(here.candidates, own, lambda F: rule.rate(F, power)[0]) for own in most)
        value, chosen_samples = min(choices, key=lambda choice: choice[0])
        gain = lowest - value
        if gain > 0:
            best, lowest = here, value
            taken = np.split(chosen_samples, np.cumsum([len(each) for each in every])[:-1])
        # Compared after the mesh is new, so that a gain which was integration error ends the turns.
        if gain < LEAST_GAIN_OF_TURN:
            break
    # What is reported is computed from the problem that is handed out, not from a sum of candidates.
    planned = Nominal(simulate_values(best.problem, e, best.theta, taken), e, best.theta)
    slope = rule.rate(best.candidates.add(np.concatenate(taken)), power)[1]
    # Derivative of log m along each sample's information. m is homogeneous of degree -1, so that those of all
    # information that is taken add up to 1 (Euler).
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


def _check_data(problem: Problem) -> None:
    """Raise ValueError unless all data are `Measurements` with sigma: their information does not depend on values."""
    for name, run in zip(problem.run_names, problem.experiments, strict=True):
        for item in run.data:
            if not isinstance(item, Measurements):
                raise ValueError(f"design needs Measurements, for the data of {name}; got {shorten(item)}.")
            if item.sigma is None:
                raise ValueError(f"design needs sigma, the standard deviation of the noise, for the data of {name}.")


def _find_chosen(problem: Problem, names: object) -> tuple[NDArray[np.intp], FloatArray]:
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
