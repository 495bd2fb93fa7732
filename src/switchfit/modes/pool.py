"""The best fit of each mode sequence that a search has found, and its criteria."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from switchfit.modes.criterion import CriterionName, Score
from switchfit.modes.fitted import Fitted

EXPLAINED = 1e-3
"""Probability of chi-square above which the data are explained, and no further start is needed."""

ModeSequences = tuple[tuple[str, ...], ...]


class Pool:
    """The lowest end of each sequence.

    Parameters
    ----------
    score : Score
    criterion : {"bic", "mbic", "aicc", "cost"}
        By which sequences are compared during the search.

    Attributes
    ----------
    undiscounted : Score
    as_it_stands : Fitted or None
        The best before the criteria were discounted; None if they were not.
    """

    def __init__(self, score: Score, criterion: CriterionName) -> None:
        self.score = self.undiscounted = score
        self.criterion = criterion
        self._found: dict[ModeSequences, Fitted] = {}
        self.as_it_stands: Fitted | None = None

    def __iter__(self) -> Iterator[Fitted]:
        return iter(self._found.values())

    def add(self, fitted: Fitted) -> None:
        """Add a fit, unless it failed or the same sequence has a lower one."""
        # One fit a sequence: what is compared are sequences, each at its best.
        known = self._found.get(fitted.sequences)
        if not fitted.failed and (known is None or fitted.cost < known.cost):
            self._found[fitted.sequences] = fitted

    def compute(self, fitted: Fitted, criterion: CriterionName | None = None, *, discounted: bool = True) -> float:
        """Return a criterion of a fit, by default that of the search."""
        name, score = criterion or self.criterion, self.score if discounted else self.undiscounted
        # The time of a guarded transition is no unknown, which an information criterion would count; its price is paid.
        switches = fitted.switches if name == "cost" else fitted.free_switches
        return score.compute(name, fitted.cost, int(fitted.acting.sum()), switches)

    @property
    def is_likelihood(self) -> bool:
        """Whether the cost is one."""
        return self.score.sigma_known is not None

    def discount(self, score: Score) -> None:
        """Compare by mBIC with a discounted score from now on.

        Parameters
        ----------
        score : Score
        """
        # By the criterion before: where a discount makes another sequence the best, that is said
        # (`ModeStatus.AMBIGUOUS`).
        self.as_it_stands = self.best
        self.score, self.criterion = score, "mbic"

    @property
    def best(self) -> Fitted | None:
        """The fit with the lowest criterion; None if there is none."""
        return min(self, key=self.compute, default=None)

    @property
    def lowest(self) -> float:
        """The criterion of the best; infinite if there is none."""
        return min(map(self.compute, self), default=np.inf)

    def is_explained(self) -> bool | None:
        """Return whether chi-square says that the best explains the data; None where it cannot say."""
        best = self.best
        probability = np.nan if best is None else self.measure_probability(best)
        return None if np.isnan(probability) else bool(probability >= EXPLAINED)

    def list_best(self, criterion: CriterionName | None = None) -> list[Fitted]:
        """Return all fits, the lowest criterion first."""
        return sorted(self, key=lambda fitted: self.compute(fitted, criterion))

    @property
    def by_switches(self) -> dict[int, Fitted]:
        """The fit of the lowest cost for each number of switches, ascending."""
        found: dict[int, Fitted] = {}
        # The lowest cost first, so that it is kept.
        for fitted in sorted(self, key=lambda fitted: fitted.cost):
            found.setdefault(fitted.switches, fitted)
        return dict(sorted(found.items()))

    def measure_probability(self, fitted: Fitted) -> float:
        """Return the probability of chi-square at its cost, NaN where 2 J has no such distribution."""
        return self.score.measure_probability(fitted.cost, int(fitted.acting.sum()) + fitted.free_switches)
