"""Compare models that were fitted to the same data: information criteria, likelihood ratios, cross-validation.

With n values, k unknowns and the largest likelihood L, all constants included,

    AIC = 2 k - 2 log L,    AICc = AIC + 2 k (k + 1) / (n - k - 1),    BIC = k log n - 2 log L       ([1]_, [2]_),

so that models of the noise may differ too: another sigma, a sigma that is a parameter, a robust loss. k counts every
unknown of theta, also one that a bound, a kink or a collapsed mode holds at the end, and one more if sigma is left out:
the residual variance is then estimated, ``2 J / n``. Priors are no data: they are not in L.

References
----------
.. [1] K. P. Burnham, D. R. Anderson, Model Selection and Multimodel Inference, 2nd ed., Springer 2002.
.. [2] G. Schwarz, Estimating the dimension of a model, Annals of Statistics 6 (1978) 461-464.
.. [3] R. B. Davies, Hypothesis testing when a nuisance parameter is present only under the alternative, Biometrika 74
   (1987) 33-43.
.. [4] S. G. Self, K.-Y. Liang, Asymptotic properties of maximum likelihood estimators and likelihood ratio tests under
   nonstandard conditions, J. Am. Stat. Assoc. 82 (1987) 605-610.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from typing import TYPE_CHECKING, Any, NamedTuple, overload

import numpy as np
import scipy.special
from numpy.typing import NDArray

from switchfit.estimation.estimator import Estimate
from switchfit.fit.solution import is_sigma_known
from switchfit.fit.trajectory import Comparison
from switchfit.problem.data import FloatArray, Measurements, TerminalConstraint
from switchfit.problem.experiment import name_runs
from switchfit.problem.losses import robust
from switchfit.problem.problem import GIVEN, Problem
from switchfit.problem.validation import as_count, as_names, as_sequence, join_names, shorten
from switchfit.runtime.presentation import draw_figure, format_html, format_line, format_text, join_first
from switchfit.strategy.choice import estimate as fit_problem
from switchfit.strategy.validation import Validation, build_other_problem, validate_problem

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class Nested(NamedTuple):
    """The likelihood ratio of two models, one of which is a special case of the other.

    Attributes
    ----------
    small, large : str
        Names of the models.
    statistic : float
        ``2 log (L_large / L_small)``; negative if the fit of the larger one is not at its best minimum.
    freedom : int
        Unknowns that the larger one has more.
    probability : float
        That chi-square with so many degrees of freedom is so large, if the smaller model is right.
    regular : bool
        Whether that distribution holds. It does not if the larger model has more transitions: where the smaller one is
        right, a mode of the larger one has zero duration, which is on the boundary, and what acts in it alone is not
        determined. The probability is then too small.

    See Also
    --------
    compare, ModelComparison

    Examples
    --------
    >>> import switchfit as sf
    >>> sf.Nested("line", "parabola", 5.2, 1, 0.023, True).large
    'parabola'
    """

    small: str
    large: str
    statistic: float
    freedom: int
    probability: float
    regular: bool


@dataclass(frozen=True, eq=False)
class ModelComparison:
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
    nested : tuple of Nested
        Likelihood ratios of the models that are special cases of others.
    folds : tuple of tuples of str
        Cross-validation: the runs that were left out together, for each fold; empty without.
    held_out : (m, folds) array
        ``-2 log L`` of the runs left out, with the parameters of the others, plus 2 for each unknown that was estimated
        from the runs left out.
    held_out_percent : (m, folds) array
        Fit of the runs left out in per cent.
    estimates : tuple of Estimate

    See Also
    --------
    compare : returns it.

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
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
    nested: tuple[Nested, ...]
    folds: tuple[tuple[str, ...], ...]
    held_out: FloatArray
    held_out_percent: FloatArray
    estimates: tuple[Estimate, ...] = field(repr=False)

    @property
    def aic(self) -> FloatArray:
        """Akaike's information criterion: (m,)."""
        return 2 * self.unknown_counts - 2 * self.log_likelihood

    @property
    def aicc(self) -> FloatArray:
        """AIC corrected for few values: (m,); infinite with no more than k + 1 values."""
        left = self.values - self.unknown_counts - 1
        more = 2 * self.unknown_counts * (self.unknown_counts + 1) / np.where(left > 0, left, 1)
        return np.where(left > 0, self.aic + more, np.inf)

    @property
    def bic(self) -> FloatArray:
        """Schwarz's Bayesian information criterion: (m,)."""
        return self.unknown_counts * np.log(self.values) - 2 * self.log_likelihood

    @property
    def delta_aicc(self) -> FloatArray:
        """AICc less the smallest: (m,); NaN if all are infinite."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.aicc - self.aicc.min())

    @property
    def delta_bic(self) -> FloatArray:
        """BIC less the smallest: (m,); above 10 a model is as good as ruled out."""
        return np.asarray(self.bic - self.bic.min())

    @property
    def weights(self) -> FloatArray:
        """Akaike weights from AICc: (m,), with the sum 1; NaN if all AICc are infinite."""
        weight = np.exp(-0.5 * self.delta_aicc)
        return np.asarray(weight / weight.sum())

    @property
    def best(self) -> str:
        """Name of the model with the smallest BIC."""
        return self.names[int(np.argmin(self.bic))]

    @overload
    def plot(self, *, ax: None = ...) -> Figure: ...
    @overload
    def plot(self, *, ax: Axes) -> Axes: ...
    def plot(self, *, ax: Axes | None = None) -> Axes | Figure:
        """Draw the differences in AICc and BIC and the Akaike weights, and the cross-validation.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Axes for the differences alone, which are returned; without them, a Figure of all is made and returned.

        See Also
        --------
        compare

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
        >>> fit = sf.estimate(heater_problem())

        >>> len(sf.compare([fit, fit], names=("one", "same")).plot().axes)
        2
        """
        return draw_figure(self, ax=ax)

    def __str__(self) -> str:
        return format_text(self)

    def __repr__(self) -> str:
        models = (f"{name} (BIC +{gap:.3g})" for name, gap in zip(self.names, self.delta_bic.tolist(), strict=True))
        return format_line(self, join_first(models), f"{self.values} values")

    def _repr_html_(self) -> str:
        return format_html(self)


def compare(
    estimates: Sequence[Estimate],
    *,
    names: Sequence[str] | None = None,
    nested: Sequence[tuple[str, str]] | None = None,
    cross_validate: bool | int = False,
) -> ModelComparison:
    """Compare models that were fitted to the same measurements: AIC, BIC, likelihood ratios, cross-validation.

    Parameters
    ----------
    estimates : sequence of Estimate
        Two or more. Their systems, mode sequences, parameters and models of the noise may differ.
    names : sequence of str, optional
        One for each; model1, model2, ... if left out.
    nested : sequence of (small, large), optional
        Names of models of which the first is a special case of the second. If left out, those whose unknowns, by name,
        are a part of the other's unknowns. That is a guess: functions of other models may use the same names.
    cross_validate : bool or int, optional
        True: leave each run out in turn, fit the others, and predict it, with its own transition times and initial
        state estimated from it (`Estimate.validate`). A number: leave out so many groups of runs. Each fit begins at
        the estimate of all runs.

    Returns
    -------
    ModelComparison

    Raises
    ------
    TypeError
        If an argument is of the wrong type.
    ValueError
        For fewer than two estimates, different data (the message says where), a cost without a likelihood, names that
        are not there, an estimate without its problem, or too few runs to leave one out.

    Notes
    -----
    Unknowns k: all of theta, and the residual variance if sigma is left out. If a sigma is a parameter, it is in theta.

    See Also
    --------
    ModelComparison, Estimate.validate, profile

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> problem = heater_problem()

    Was the heater switched off at all?

    >>> log, power = problem.experiments[0].data, problem.parameters["power"]
    >>> never = sf.Experiment(log, ("on",), (), 0.0, 6.0, time_unit="h")
    >>> on = sf.Problem(problem.system, never, {"k": sf.Parameter(0.5, lower=0.01), "power": power})
    >>> table = sf.compare([sf.estimate(on), sf.estimate(problem)], names=("on", "on, off"))
    >>> table.best, table.nested[0].regular
    ('on, off', False)
    """
    fits = as_sequence(estimates, "estimates", "a sequence of results of sf.estimate")
    wrong = next((fit for fit in fits if not isinstance(fit, Estimate)), None)
    if wrong is not None:
        raise TypeError(f"compare needs results of sf.estimate; got {type(wrong).__name__}.")
    if len(fits) < 2:
        raise ValueError(f"compare needs two estimates or more; got {len(fits)}.")
    given = tuple(f"model{k + 1}" for k in range(len(fits))) if names is None else names
    labels = as_names(given, "names", "a sequence of strings, one for each estimate")
    if len(labels) != len(fits):
        raise ValueError(f"names must have one entry for each of the {len(fits)} estimates; got {shorten(labels)}.")
    problems = [fit.evaluator_at_solution().problem for fit in fits]
    for label, problem in zip(labels, problems, strict=True):
        if is_sigma_known(problem) is None:
            raise ValueError(f"{label} has no likelihood: its cost has other terms than Measurements.")
    for label, problem in zip(labels[1:], problems[1:], strict=True):
        difference = find_difference(problems[0], problem)
        if difference:
            raise ValueError(
                f"{labels[0]} and {label} were fitted to different data, which cannot be compared: {difference}."
            )
    likelihoods = np.array([compute_log_likelihood(p, fit.comparisons) for p, fit in zip(problems, fits, strict=True)])
    unknowns = np.array([len(fit.theta) + (fit.sigma_known is False) for fit in fits])
    if nested is None:
        pairs = _guess_nested(labels, fits)
    else:
        pairs = [_check_pair(pair, labels) for pair in as_sequence(nested, "nested", "a sequence of (small, large)")]
    folds = _choose_folds(problems, cross_validate)
    scores = [[_hold_out(fit, problem, fold) for fold in folds] for fit, problem in zip(fits, problems, strict=True)]
    table = np.array(scores, dtype=float).reshape(len(fits), len(folds), 2)
    return ModelComparison(
        labels,
        sum(item.count for run in problems[0].experiments for item in list_measurements(run.data)),
        unknowns,
        likelihoods,
        tuple(_compare_nested(labels, fits, problems, likelihoods, unknowns, *pair) for pair in pairs),
        folds,
        table[..., 0],
        table[..., 1],
        tuple(fits),
    )


def list_measurements(data: Iterable[Any]) -> list[Measurements]:
    """Return the Measurements among the data of an experiment.

    Parameters
    ----------
    data : iterable
    """
    return [item for item in data if not isinstance(item, TerminalConstraint)]


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
        items = [list_measurements(run.data) for run in pair]
        if len(items[0]) != len(items[1]):
            return f"{len(items[0])} and {len(items[1])} Measurements{where}"
        for a, b in zip(*items, strict=True):
            if a.values.shape != b.values.shape:
                return f"values{where} of shape {a.values.shape} and {b.values.shape}"
            for what, x, y in (("times", a.times, b.times), ("values", a.values, b.values)):
                if not np.array_equal(x, y, equal_nan=True):
                    differs = ~((x == y) | (np.isnan(x) & np.isnan(y)))
                    k = tuple(np.argwhere(differs)[0].tolist())
                    return f"{what}{where} differ first at index {k[0]}, {x[k]:.6g} and {y[k]:.6g}"
    return ""


def compute_log_likelihood(problem: Problem, comparisons: Sequence[Sequence[Comparison]]) -> float:
    """Return the log-likelihood of all samples, constants included, without priors.

    If sigma is left out, it is the largest over sigma, at ``sigma^2 = 2 J / n``.

    Parameters
    ----------
    problem : Problem
    comparisons : sequence of sequences of Comparison, one for each experiment
    """
    total, squares, count = 0.0, 0.0, 0
    known = is_sigma_known(problem)
    for run, own in zip(problem.experiments, comparisons, strict=True):
        for item, comparison in zip(list_measurements(run.data), own, strict=True):
            there = np.isfinite(comparison.residuals)
            r = comparison.residuals[there]
            sigma = np.ones(len(r)) if comparison.sigma is None else comparison.sigma[there]
            u = (r / sigma) ** 2
            total -= float(np.log(sigma).sum())
            squares += float(u.sum())
            count += len(r)
            if known:
                total -= 0.5 * float(np.sum(robust(item.loss, item.loss_scale, u)))
                total -= len(r) * compute_log_norm(item.loss, item.loss_scale)
    if known:
        return total
    return total - 0.5 * count * (np.log(2 * np.pi * squares / count) + 1)


def compute_log_norm(loss: str, scale: float) -> float:
    """Return the logarithm of the integral of ``exp(-rho)`` over residuals in sigmas, by which a loss is a density.

    Infinite for a Cauchy loss with a scale up to 1, which is no density.

    Parameters
    ----------
    loss : str
    scale : float
    """
    if loss == "linear":
        return 0.5 * float(np.log(2 * np.pi))
    if loss == "cauchy":  # the integral of (1 + z^2 / C^2)^(-C^2 / 2), Student's
        if scale <= 1:
            return np.inf
        a = 0.5 * scale**2
        return float(np.log(scale) + 0.5 * np.log(np.pi) + scipy.special.gammaln(a - 0.5) - scipy.special.gammaln(a))
    from scipy.integrate import quad  # here, since importing it takes longer than most comparisons

    def density(z: float) -> float:
        return float(np.exp(-0.5 * robust(loss, scale, np.float64(z * z))))

    parts = [quad(density, a, b, epsabs=0.0, epsrel=1e-10)[0] for a, b in ((0.0, scale), (scale, np.inf))]
    return float(np.log(2 * sum(parts)))


def _guess_nested(labels: Sequence[str], fits: Sequence[Estimate]) -> list[tuple[int, int]]:
    """Return the pairs (small, large) of models whose unknowns are a part of the other's, by name."""
    pairs = []
    for a, b in permutations(range(len(labels)), 2):
        small, large = set(fits[a].theta_names), set(fits[b].theta_names)
        if small < large and fits[a].sigma_known == fits[b].sigma_known:
            pairs.append((a, b))
    return pairs


def _check_pair(pair: Any, labels: Sequence[str]) -> tuple[int, int]:
    entries = as_names(pair, "each of nested", "a pair (small, large) of names")
    missing = [name for name in entries if name not in labels]
    if len(entries) != 2 or missing:
        raise ValueError(
            f"each of nested must be two of the names {join_names(labels)}, the smaller model first; got "
            f"{shorten(pair)}."
        )
    return labels.index(entries[0]), labels.index(entries[1])


def _compare_nested(
    labels: Sequence[str],
    fits: Sequence[Estimate],
    problems: Sequence[Problem],
    likelihoods: FloatArray,
    unknowns: NDArray[np.int64],
    small: int,
    large: int,
) -> Nested:
    freedom = int(unknowns[large] - unknowns[small])
    if freedom <= 0:
        raise ValueError(
            f"nested: {labels[small]} has {unknowns[small]} unknowns and {labels[large]} {unknowns[large]}; the "
            "smaller model comes first."
        )
    statistic = float(2 * (likelihoods[large] - likelihoods[small]))
    counts = [[len(run.mode_sequence) for run in problems[k].experiments] for k in (small, large)]
    probability = float(scipy.special.chdtrc(freedom, max(statistic, 0.0)))
    return Nested(labels[small], labels[large], statistic, freedom, probability, counts[0] == counts[1])


def _choose_folds(problems: Sequence[Problem], given: bool | int) -> tuple[tuple[str, ...], ...]:
    """Return the runs that are left out together, for each fold."""
    if given is False:
        return ()
    runs = name_runs(problems[0].experiments)
    if len(runs) < 2:
        raise ValueError(
            "cross_validate leaves runs out, and the problem has one: give the Problem several experiments, or use "
            "validate with another log."
        )
    if any(name_runs(problem.experiments) != runs for problem in problems):
        raise ValueError("cross_validate needs experiments of the same names in all models.")
    count = len(runs) if given is True else as_count(given, "cross_validate", at_least=2, at_most=len(runs))
    return tuple(tuple(runs[k::count]) for k in range(count))


def _hold_out(estimate: Estimate, problem: Problem, fold: tuple[str, ...]) -> tuple[float, float]:
    """Return the score of the runs of a fold with the parameters of the other runs, and their fit in per cent."""
    runs = name_runs(problem.experiments)
    rest = [name for name in runs if name not in fold]
    train, test = problem.without_runs(*fold), problem.without_runs(*rest)
    start = _carry_theta(problem, estimate.theta, train, [runs.index(name) for name in rest])
    fit = fit_problem(train, start=start, strategy="local")  # from the fit of all runs, others are not looked for
    begin = _begin_at(test, _carry_theta(problem, estimate.theta, test, [runs.index(name) for name in fold]))
    found = validate_problem(fit, build_other_problem(fit, begin), None, "local")
    return score(found), found.percent


def score(found: Validation) -> float:
    """Return ``-2 log L`` of a validation plus 2 for each unknown that was estimated from its data.

    Where sigma is left out, it is the residual variance of the fit.

    Parameters
    ----------
    found : Validation
    """
    own = 0 if found.refit is None else len(found.refit.theta)
    if found.sigma_known:
        return -2 * compute_log_likelihood(found.problem, found.comparisons) + 2 * own
    squares, count, logs = 0.0, 0, 0.0
    for comparison in (c for run in found.comparisons for c in run):
        there = np.isfinite(comparison.residuals)
        sigma = np.ones(int(there.sum())) if comparison.sigma is None else comparison.sigma[there]
        squares += float(np.sum((comparison.residuals[there] / sigma) ** 2))
        count += len(sigma)
        logs += float(np.log(sigma).sum())
    variance = found.fit.residual_variance
    return squares / variance + count * float(np.log(2 * np.pi * variance)) + 2 * logs + 2 * own


def _carry_theta(problem: Problem, theta: FloatArray, part: Problem, kept: Sequence[int]) -> FloatArray:
    """Return the theta of a part of a problem: some of its runs (from 0), in the same order."""
    whole, own = problem.unknowns, part.unknowns
    found = part.initial_theta
    for e, run in enumerate(kept):
        for there, here in ((whole.times[run], own.times[e]), (whole.initial_states[run], own.initial_states[e])):
            found[here[here >= 0]] = theta[there[there >= 0]]
    for name, span in own.parameters.items():
        found[span] = theta[whole.parameters[name]]
    return found


def _begin_at(problem: Problem, theta: FloatArray) -> Problem:
    """Return a problem with another first guess of its transition times, where these are in order."""
    runs = []
    for run, where in zip(problem.experiments, problem.unknowns.times, strict=True):
        times = run.initial_times
        times[where >= 0] = theta[where[where >= 0]]
        if np.all(np.diff(run.ends_of_modes(times)) > 0):
            moved = [replace(tau, value=value) for tau, value in zip(run.times, times, strict=True)]
            count = len(run.transition_times)
            run = replace(run, transition_times=tuple(moved[:count]), tf=moved[count] if run.has_free_tf else run.tf)
        runs.append(run)
    return Problem(**{name: getattr(problem, name) for name in GIVEN} | {"experiments": runs})
