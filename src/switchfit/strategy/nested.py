"""Likelihood ratios of models, one of which is a special case of the other.

References
----------
.. [1] R. B. Davies, Hypothesis testing when a nuisance parameter is present only under the alternative, Biometrika 74
   (1987) 33-43.
.. [2] S. G. Self, K.-Y. Liang, Asymptotic properties of maximum likelihood estimators and likelihood ratio tests under
   nonstandard conditions, J. Am. Stat. Assoc. 82 (1987) 605-610.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.estimation.estimator import Estimate
from switchfit.problem.data import FloatArray, Measurements
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem
from switchfit.problem.validation import as_names, join_names, shorten
from switchfit.runtime import special
from switchfit.strategy.likelihood import list_measurements

ROUNDING = 1e-9
"""Difference of two log-likelihoods, relative to one of them, that is rounding."""


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
        Of so large a statistic, or a larger one, if the smaller model is right: that of chi-square with so many degrees
        of freedom. If the larger model has one unknown more, and the smaller one is that with this unknown at a bound,
        it is half of that: in every other log the estimate is at the bound.
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


def guess_nested(
    fits: Sequence[Estimate], problems: Sequence[Problem], counts: NDArray[np.int64]
) -> list[tuple[int, int]]:
    """Return the pairs (small, large) of models of which the first is a special case of the second, judged by names.

    Parameters
    ----------
    fits : sequence of Estimate
    problems : sequence of Problem
    counts : (m,) int array
        Unknowns of each model.
    """
    return [
        (a, b)
        for a, b in permutations(range(len(fits)), 2)
        if set(fits[a].theta_names) <= set(fits[b].theta_names)
        and counts[a] < counts[b]
        and may_be_nested(problems[a], problems[b])
    ]


def may_be_nested(small: Problem, large: Problem) -> bool:
    """Return whether a problem whose unknowns are a part of another's can be a special case of it.

    It cannot if its modes, in their order, are not among the other's, where a mode that only the other one has may
    stand for any, since its parameters may make it the same; if its noise or loss is another; if something that is
    fixed in both has another value; or if the larger one has a constraint that it lacks.

    Parameters
    ----------
    small, large : Problem
    """
    if not set(large.constraint_names) <= set(small.constraint_names):
        return False
    for name, parameter in large.parameters.items():
        other = small.parameters.get(name, parameter)
        if parameter.fixed and not np.array_equal(parameter.value, other.value):
            return False
    known = {mode for run in small.experiments for mode in run.mode_sequence}
    runs = zip(small.experiments, large.experiments, strict=True)
    return all(_may_be_nested_runs(*pair, known) for pair in runs)


def _may_be_nested_runs(small: Experiment, large: Experiment, known: Collection[str]) -> bool:
    """Return whether a run can be the other one with some modes of zero duration; `known` modes are what they are."""
    modes = iter(large.mode_sequence)  # each is found behind the one before it
    if not all(any(other == mode or other not in known for other in modes) for mode in small.mode_sequence):
        return False
    if len(small.mode_sequence) == len(large.mode_sequence):
        pairs = zip(small.transition_times, large.transition_times, strict=True)
        if any(a.fixed and b.fixed and a.value != b.value for a, b in pairs):
            return False
    items = zip(list_measurements(small.data), list_measurements(large.data), strict=True)
    return all(_may_have_noise_of(a, b) for a, b in items)


def _may_have_noise_of(small: Measurements, large: Measurements) -> bool:
    """Return whether loss and sigma are the same, or sigma a number where it is a parameter of the larger model."""
    a, b = small.sigma, large.sigma
    if (small.loss, small.loss_scale) != (large.loss, large.loss_scale) or (a is None) != (b is None):
        return False
    if a is None or not isinstance(b, tuple):
        return a is None or (not isinstance(a, tuple) and bool(np.all(np.asarray(a) == b)))
    if not isinstance(a, tuple):
        if a.ndim == 2:
            return False
        a = tuple(np.broadcast_to(a, len(b)).tolist())
    return all(
        own == other or (isinstance(other, str) and not isinstance(own, str)) for own, other in zip(a, b, strict=True)
    )


def check_pair(pair: Any, labels: Sequence[str]) -> tuple[int, int]:
    """Return the indices of the smaller and the larger model of a pair of names.

    Parameters
    ----------
    pair : (str, str)
    labels : sequence of str
        Names of all models.
    """
    entries = as_names(pair, "each of nested", "a pair (small, large) of names")
    missing = [name for name in entries if name not in labels]
    if len(entries) != 2 or missing:
        raise ValueError(
            f"each of nested must be two of the names {join_names(labels)}, the smaller model first; got "
            f"{shorten(pair)}."
        )
    return labels.index(entries[0]), labels.index(entries[1])


def compare_nested(
    labels: Sequence[str],
    problems: Sequence[Problem],
    likelihoods: FloatArray,
    unknowns: NDArray[np.int64],
    small: int,
    large: int,
) -> Nested:
    """Return the likelihood ratio of two models; where it is at a bound by [2]_.

    Parameters
    ----------
    labels : sequence of str
    problems : sequence of Problem
    likelihoods : (m,)
        Logarithms, constants included.
    unknowns : (m,) int array
    small, large : int
        Indices of the two models.
    """
    freedom = int(unknowns[large] - unknowns[small])
    if freedom <= 0:
        raise ValueError(
            f"nested: {labels[small]} has {unknowns[small]} unknowns and {labels[large]} {unknowns[large]}; the "
            "smaller model comes first."
        )
    statistic = float(2 * (likelihoods[large] - likelihoods[small]))
    if abs(statistic) <= ROUNDING * max(1.0, abs(likelihoods[small])):  # the same fit: not a worse one by rounding
        statistic = 0.0
    counts = [[len(run.mode_sequence) for run in problems[k].experiments] for k in (small, large)]
    probability = float(special.chdtrc(freedom, max(statistic, 0.0)))
    if freedom == 1 and statistic > 0 and _is_at_bound(problems[small], problems[large]):
        probability *= 0.5
    return Nested(labels[small], labels[large], statistic, freedom, probability, counts[0] == counts[1])


def _is_at_bound(small: Problem, large: Problem) -> bool:
    """Return whether the smaller model fixes a number at a bound that it has in the larger one."""
    more = [name for name in large.unknowns.parameters if name not in small.unknowns.parameters]
    bounds = [(small.parameters.get(name), large.parameters[name]) for name in more]
    return any(
        held is not None and held.fixed and held.shape == () and held.value in (free.lower, free.upper)
        for held, free in bounds
    )
