"""What all fits of a problem share: names, units and bounds of the unknowns, and which of them are which times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.problem.problem import Problem, keep_with_problem


@dataclass(frozen=True, eq=False, kw_only=True)
class Layout:
    """What the numbers of a fit stand for; d unknowns in the order of `theta_names`.

    Attributes
    ----------
    theta_names, theta_units : tuple of str
    lower, upper : (d,)
        Bounds of theta.
    run_names : tuple of str, one per experiment
        Its name, or run1, run2, ...
    transition_places : tuple of (N,) int arrays, one per experiment
        Index in theta of each transition time; -1 if it is fixed.
    final_places : tuple of int, one per experiment
        Index in theta of its tf; -1 if it is fixed.
    parameter_units : dict of name -> str, fixed ones included
    fixed : tuple of str
        Names of the parameters that are fixed.
    sigma_known : bool or None
        Whether the noise of the measurements is known; None if the cost has no noise model.
    priors : dict of name -> str
        The prior of each unknown that has one, in words.
    log_scaled : tuple of str
        Unknowns that were estimated on a logarithmic scale.
    log_origins : (d,)
        From where these logarithms count: t0 for a transition time, otherwise 0.
    least_squares : bool
        Whether the terms of measurements and priors in J are half a sum of squares: no sigma is a parameter, no loss is
        robust.
    """

    theta_names: tuple[str, ...]
    theta_units: tuple[str, ...]
    lower: FloatArray
    upper: FloatArray
    run_names: tuple[str, ...]
    transition_places: tuple[NDArray[np.intp], ...]
    final_places: tuple[int, ...]
    parameter_units: Mapping[str, str]
    fixed: tuple[str, ...]
    sigma_known: bool | None
    priors: Mapping[str, str] = field(default_factory=dict)
    log_scaled: tuple[str, ...] = ()
    log_origins: FloatArray
    least_squares: bool = True


@keep_with_problem
def layout_of(problem: Problem) -> Layout:
    """Return the layout of a problem's fits."""
    unknowns, parameters = problem.unknowns, problem.parameters
    counts = [len(run.transition_times) for run in problem.experiments]
    times = list(zip(unknowns.times, counts, strict=True))
    return Layout(
        theta_names=unknowns.names,
        theta_units=unknowns.units,
        lower=unknowns.lower,
        upper=unknowns.upper,
        run_names=problem.run_names,
        transition_places=tuple(where[:count] for where, count in times),
        final_places=tuple(int(where[count]) if len(where) > count else -1 for where, count in times),
        parameter_units={name: parameter.unit for name, parameter in parameters.items()},
        fixed=tuple(name for name, parameter in parameters.items() if parameter.fixed),
        sigma_known=problem.is_sigma_known,
        priors={name: text for name, text in zip(unknowns.names, unknowns.priors.texts(), strict=True) if text},
        log_scaled=unknowns.log_names,
        log_origins=unknowns.origin,
        least_squares=problem.is_least_squares,
    )
