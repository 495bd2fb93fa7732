"""Monte Carlo: simulate the data of a problem, perturb them, fit again, thousands of times."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.batch.fits import Fits
from switchfit.batch.long_run import LongRun, repeat
from switchfit.batch.simulated_study import Noise, build_study
from switchfit.batch.study_verdict import judge_study
from switchfit.fit.guards import place_on_guards
from switchfit.fit.local_fit import fit_locally
from switchfit.problem.problem import Problem, require_estimable
from switchfit.problem.validation import objects
from switchfit.problem.validation.arrays import as_array, as_count, as_seed
from switchfit.uncertainty.verdict import Verdict


@dataclass(frozen=True, eq=False, repr=False)
class MonteCarlo(Fits):
    """Result of `monte_carlo`: everything in `Fits`, and the truth. Print it for the table.

    Attributes
    ----------
    truth : (d,)
        At which the data were simulated.
    integration_error : float
        Error of J at the truth by halving all steps, relative to J, or to 1e-3 of J at the start where that is more.

    See Also
    --------
    monte_carlo, Fits, bootstrap

    Examples
    --------
    >>> problem = heater_problem()

    >>> study = sf.monte_carlo(problem, 20, theta=[2.5, 0.4])
    >>> study.bias.shape, study.coverage().shape
    ((2,), (2,))
    """

    truth: FloatArray
    integration_error: float

    @cached_property
    def verdict(self) -> Verdict:
        """Whether to believe the study: how many fits converged, in the same minimum as the others, whether chi-square
        confirms them, and whether their 95 % intervals hold the truth. Print it for a line.
        """
        return judge_study(self, truth=self.truth, error=self.integration_error)

    @property
    def errors(self) -> FloatArray:
        """Estimate less truth of the fits that converged: (S, d)."""
        return self.theta[self.success] - self.truth

    @property
    def bias(self) -> FloatArray:
        """Mean error: (d,)."""
        return self.errors.mean(0)

    @property
    def standard_deviation(self) -> FloatArray:
        """Of the estimates round their mean: (d,)."""
        return self.errors.std(0, ddof=1)

    def coverage(self, level: float = 0.95) -> FloatArray:
        """Return the part of the fits that converged whose interval contains the truth: (d,); NaN without a noise
        model, and for an unknown that is held in all of them.

        See Also
        --------
        monte_carlo, Fits.confidence_intervals

        Examples
        --------
        >>> problem = heater_problem()

        >>> study = sf.monte_carlo(problem, 20, theta=[2.5, 0.4])
        >>> bool((study.coverage(0.95) > 0.7).all())
        True
        """
        low, high = np.moveaxis(self.confidence_intervals(level)[self.success], 2, 0)
        inside = (low <= self.truth) & (self.truth <= high)
        return np.where(np.isnan(low).all(0), np.nan, inside.mean(0))


def monte_carlo(
    problem: Problem,
    runs: int = 1000,
    *,
    theta: ArrayLike | None = None,
    start: ArrayLike | None = None,
    noise: Noise = None,
    seed: int = 0,
    tolerance: float = 1e-7,
    max_iterations: int = 200,
    client: Any = None,
    folder: str | Path | None = None,
    callback: Callable[[int, int], object] | None = None,
) -> MonteCarlo:
    """Simulate the data of a problem, add noise, and fit them, many times.

    Parameters
    ----------
    problem : Problem
        Its data say what is measured when; their values are replaced, missing ones stay missing.
    runs : int
    theta : (d,) array_like, optional
        The truth; the problem's estimate if left out (a parametric bootstrap).
    start : (d,) array_like, optional
        Where every fit begins; the truth if left out. Give the problem's ``initial_theta`` to study convergence too.
    noise : optional
        Standard deviation of Gaussian noise: a number, one for each channel (q,), or by default the sigma of each of
        the `Measurements`. Or a function ``noise(rng, clean, item) -> (K, q)`` that returns the noisy values of one
        of the data from the clean ones.
    seed : int
        Run k draws from ``numpy.random.default_rng([seed, k])``, wherever and in whatever order it is done.
    tolerance, max_iterations : as of `estimate`
    client : dask.distributed.Client, optional
        A cluster to run on (extra ``cluster``); the cores of this machine if left out.
    folder : path, optional
        Where what is done is kept, so that a broken run goes on.
    callback : callable, optional
        ``callback(done, total)`` after each chunk; a true return value stops. Ctrl-C does as well; what is done is
        returned.

    Returns
    -------
    MonteCarlo

    Raises
    ------
    ValueError
        If the noise is not known, there are no Measurements or other signals to simulate, or the folder holds something
        else.
    TypeError
        If an argument is of the wrong type.

    Notes
    -----
    All fits share one mesh, which resolves the trajectories at the start and at the truth. Transition times that have
    guards are moved onto them in the truth.

    See Also
    --------
    bootstrap, estimate_many

    Examples
    --------
    >>> problem = heater_problem()

    >>> study = sf.monte_carlo(problem, 20, theta=[2.5, 0.4], seed=1)
    >>> len(study), bool((study.standard_deviation < 0.05).all())
    (20, True)
    """
    objects.as_instance(problem, "problem", Problem, "an sf.Problem")
    require_estimable(problem)
    runs, seed = as_count(runs, "runs", at_least=1), as_seed(seed)
    how = LongRun.check(tolerance, max_iterations, client, folder, callback)
    noise = _check_noise(noise)
    given = None if theta is None else problem.check_theta(theta)
    begin = None if start is None else problem.check_theta(start, "start")
    truth = fit_locally(problem).theta if given is None else given
    if given is not None and problem.constraint_names:
        with suppress(ValueError):  # it is not near the guards
            truth = place_on_guards(problem, given)[1]
    begin = truth if begin is None else begin
    study, error = build_study(problem, truth, begin, noise, seed, how.limits)
    return MonteCarlo(**repeat(problem, study, runs, "Monte Carlo", how), truth=truth, integration_error=error)


def _check_noise(noise: Noise) -> Noise:
    """Return the noise as an array, a function or None."""
    if noise is None:
        return None
    if callable(noise):
        return objects.as_callable(noise, "noise", "a function noise(rng, clean, item)", arguments=3)
    return as_array(noise, "noise", form="a number, one for each channel, or a function")
