"""Compare models that were fitted to the same data, by information criteria.

With n values, k unknowns and the largest likelihood L, all constants included,

    AIC = 2 k - 2 log L,    AICc = AIC + 2 k (k + 1) / (n - k - 1),    BIC = k log n - 2 log L       ([1]_, [2]_),

so that models of the noise may differ too: another sigma, a sigma that is a parameter, a robust loss. k counts every
unknown of theta, also one that a bound, a kink or a collapsed mode holds at the end, less one for each guard and each
terminal constraint, which are equations between unknowns, and one more if sigma is left out: the residual variance is
then estimated, ``2 J / n``. Priors are no data: they are not in L.

References
----------
.. [1] K. P. Burnham, D. R. Anderson, Model Selection and Multimodel Inference, 2nd ed., Springer 2002.
.. [2] G. Schwarz, Estimating the dimension of a model, Annals of Statistics 6 (1978) 461-464.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.estimation.estimates import Estimate
from switchfit.problem.experiment import name_runs
from switchfit.problem.problem import Problem
from switchfit.problem.validation.names import as_labels
from switchfit.problem.validation.objects import as_instances
from switchfit.runtime.presentation import Displayed, format_line, join_first
from switchfit.strategy.likelihood import compute_log_likelihood


@dataclass(frozen=True, eq=False)
class ModelComparison(Displayed):
    """Several models of the same data; print it for a table.

    Attributes
    ----------
    names : tuple of str, one for each of the m models
    values : int
        Measured values, n.
    unknown_counts : (m,) int array
        k, see `compare`.
    log_likelihood : (m,) array
        Natural logarithm of the largest likelihood, all constants included.
    estimates : tuple of Estimate

    See Also
    --------
    compare : returns it.

    Examples
    --------
    >>> problem = heater_problem()

    >>> known = dict(problem.parameters) | {"k": sf.Parameter(0.45, fixed=True)}
    >>> fits = [sf.estimate(sf.Problem(problem.system, problem.experiments, p)) for p in (known, problem.parameters)]
    >>> table = sf.compare(fits, names=("k known", "k estimated"))
    >>> table.unknown_counts.tolist(), table.delta_bic.round(1).tolist()
    ([1, 2], [104.7, 0.0])
    >>> table.best
    'k estimated'
    """

    names: tuple[str, ...]
    values: int
    unknown_counts: NDArray[np.int64]
    log_likelihood: FloatArray
    estimates: tuple[Estimate, ...] = field(repr=False)

    @property
    def aic(self) -> FloatArray:
        """Akaike's information criterion: (m,)."""
        return 2 * self.unknown_counts - 2 * self.log_likelihood

    @property
    def aicc(self) -> FloatArray:
        """AIC corrected for few values: (m,); infinite with no more than k + 1 values."""
        left = self.values - self.unknown_counts - 1
        # Divided by 1 where nothing is left, only to be replaced by infinity.
        more = 2 * self.unknown_counts * (self.unknown_counts + 1) / np.where(left > 0, left, 1)
        return np.where(left > 0, self.aic + more, np.inf)

    @property
    def bic(self) -> FloatArray:
        """Schwarz's Bayesian information criterion: (m,)."""
        return self.unknown_counts * np.log(self.values) - 2 * self.log_likelihood

    @property
    def delta_aicc(self) -> FloatArray:
        """AICc less the smallest: (m,); NaN if all are infinite."""
        # inf - inf: no model has values left.
        with np.errstate(invalid="ignore"):
            return np.asarray(self.aicc - self.aicc.min())

    @property
    def delta_bic(self) -> FloatArray:
        """BIC less the smallest: (m,); above 10 a model is as good as ruled out."""
        return np.asarray(self.bic - self.bic.min())

    @property
    def weights(self) -> FloatArray:
        """Akaike weights from AICc: (m,), with the sum 1; NaN if all AICc are infinite."""
        # Differences first: exp(-AICc / 2) alone underflows.
        weight = np.exp(-0.5 * self.delta_aicc)
        return np.asarray(weight / weight.sum())

    @property
    def best(self) -> str:
        """Name of the model with the smallest BIC."""
        return self.names[int(np.argmin(self.bic))]

    def __repr__(self) -> str:
        models = (f"{name} (BIC +{gap:.3g})" for name, gap in zip(self.names, self.delta_bic.tolist(), strict=True))
        return format_line(self, join_first(models), f"{self.values} values")


def compare(estimates: Sequence[Estimate], *, names: Sequence[str] | None = None) -> ModelComparison:
    """Compare models that were fitted to the same measurements, by AIC, AICc and BIC.

    Parameters
    ----------
    estimates : sequence of Estimate
        Two or more. Their systems, mode sequences, parameters and models of the noise may differ.
    names : sequence of str, optional
        One for each; model1, model2, ... if left out.

    Returns
    -------
    ModelComparison

    Raises
    ------
    TypeError
        If an argument is of the wrong type.
    ValueError
        For fewer than two estimates, different data (the message says where), a cost without a likelihood, names that
        are not one for each, or an estimate without its problem.

    Notes
    -----
    Unknowns k: all of theta, less the number of guards and terminal constraints, and the residual variance if sigma is
    left out. If a sigma is a parameter, it is in theta.

    For cross-validation, fit all runs but one, and predict it: ``sf.estimate(others).validate(run_3)``.

    See Also
    --------
    ModelComparison, Estimate.validate, profile

    Examples
    --------
    >>> problem = heater_problem()

    Was the heater switched off at all?

    >>> log, power = problem.experiments[0].data, problem.parameters["power"]
    >>> never = sf.Experiment(log, ("on",), (), 0.0, 6.0, time_unit="h")
    >>> on = sf.Problem(problem.system, never, {"k": sf.Parameter(0.5, lower=0.01), "power": power})
    >>> table = sf.compare([sf.estimate(on), sf.estimate(problem)], names=("on", "on, off"))
    >>> table.best, table.delta_bic.round(1).tolist()
    ('on, off', [8476.6, 0.0])
    """
    fits = list(as_instances(estimates, "estimates", Estimate, "a result of sf.estimate"))
    if len(fits) < 2:
        raise ValueError(f"compare needs two estimates or more; got {len(fits)}.")
    labels = as_labels(names, "names", "estimate", len(fits)) or tuple(f"model{k + 1}" for k in range(len(fits)))
    problems = [fit.evaluator_at_solution().problem for fit in fits]
    _check_data(labels, problems)
    likelihoods = np.array([compute_log_likelihood(p, fit.comparisons) for p, fit in zip(problems, fits, strict=True)])
    # k: all of theta, less its equality constraints, and an unknown variance.
    unknowns = np.array([len(fit.theta) - len(fit.constraints) + (fit.sigma_known is False) for fit in fits])
    # All have the same data (`_check_data`).
    count = sum(item.count for item in problems[0].measurements)
    return ModelComparison(labels, count, unknowns, likelihoods, tuple(fits))


def _check_data(labels: Sequence[str], problems: Sequence[Problem]) -> None:
    """Raise ValueError unless all models have a likelihood of the same data."""
    for label, problem in zip(labels, problems, strict=True):
        if problem.is_sigma_known is None:
            raise ValueError(f"{label} has no likelihood: its cost has other terms than Measurements.")
        for item in problem.measurements:
            if item.loss == "cauchy" and item.loss_scale <= 1:  # its integral is infinite
                raise ValueError(
                    f"{label} has no likelihood: loss='cauchy' is a density only with a loss_scale above 1; got "
                    f"{item.loss_scale:g}."
                )
    for label, problem in zip(labels[1:], problems[1:], strict=True):
        difference = find_difference(problems[0], problem)
        if difference:
            raise ValueError(
                f"{labels[0]} and {label} were fitted to different data, which cannot be compared: {difference}."
            )


def find_difference(first: Problem, second: Problem) -> str:
    """Return where the measured times and values of two problems differ, in words; an empty string if nowhere.

    Parameters
    ----------
    first, second : Problem
    """
    runs = first.experiments, second.experiments
    if len(runs[0]) != len(runs[1]):
        return f"{len(runs[0])} and {len(runs[1])} experiments"
    for label, *pair in zip(name_runs(runs[0]), *runs, strict=True):
        where = "" if len(runs[0]) == 1 else f" of {label}"
        items = [run.measurements for run in pair]
        if len(items[0]) != len(items[1]):
            return f"{len(items[0])} and {len(items[1])} Measurements{where}"
        for a, b in zip(*items, strict=True):
            for what, x, y in (("times", a.times, b.times), ("values", a.values, b.values)):
                # Shapes first: `array_equal` is False for them without saying why.
                if x.shape != y.shape:
                    return f"{what}{where} of shape {x.shape} and {y.shape}"
                if not np.array_equal(x, y, equal_nan=True):
                    return f"{what}{where} differ"
    return ""
