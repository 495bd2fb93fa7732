"""What speaks against fits, from numbers alone: the same rules and thresholds for one fit and for many.

Three questions, each answered by one number with one threshold:

1. Did it converge, on a mesh that is fine enough? The relative integration error of J, `FINE`.
2. Is it the best that was found, and who looked? The number of ends that are lower, 0. Where nothing says what the
   noise is, the share of other starts that ended at the same J too, `AGREEING`.
3. Does the model explain the data? The probability of what is left if it is noise, `UNLIKELY_AS_NOISE`; where that
   cannot be told, the share of the variance that is explained, `MOSTLY`.

No to the first or second is bad, and so is a model that explains less than it leaves (`HALF`), unless what is left is
noise. What is left and is no noise is doubtful: a wrong end, a wrong model, a wrong sigma and outliers all do that. So
is whatever the data do not determine. A wrong answer that is called good is the worst defect of such a rule, a right
one that is called bad the second.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from switchfit.uncertainty.chi_square import UNLIKELY_AS_NOISE
from switchfit.uncertainty.explained_variance import HALF, NO_RESIDUALS

OfFits: TypeAlias = Any
"""A number of one fit, or an array (F,) with that of each of many: the same rules judge both."""

Level = Literal["good", "doubtful", "bad"]
VERDICT_LEVELS: tuple[Level, ...] = ("good", "doubtful", "bad")

FINE = 1e-3
"""Integration error of J, relative, up to which a minimum is that of the data: chi-square is off by less than 1 in a
thousand samples then. Above it, the minimum may be that of the mesh."""

AGREEING = 0.1
"""Share of other starts that end in the same minimum below which it is doubtful that there is no better one, unless
what is left of the data is noise."""

MOSTLY = 0.9
"""Share below which a fit is doubtful where no test tells whether what is left is noise: fewer than 20 values without a
sigma, and fits of many. A tenth of the variance is to be seen in a figure."""

NEARLY_ALL = 0.999
"""Share from which a reference signal is followed, whose noise cannot be told from a misfit, and from which a model
with correlated residuals is no more than slightly wrong: they are 3 % of the signal. Wrong ends of the test bed reach
0.99893 of references and 0.99884 of data; real logs that are fitted rightly and leave no noise have more."""

BARELY_DETERMINED = 1e-6
"""Smallest eigenvalue of the Hessian, scaled to unit curvature, below which a direction is not determined: correlations
of 0.999999 have it."""


@dataclass(frozen=True)
class Numbers:
    """Numbers about R fits from which they are judged: arrays (R,), or one number where it is that of all of them.

    Attributes
    ----------
    converged : (R,) bool
    error
        Integration error of J, or of a constraint, relative.
    lower, tried, agreeing
        How many other starts ended lower, were tried, and ended at the same J.
    explained
        Share of the variance of the data; NaN without data, or if they do not vary.
    probability
        Of what is left of the data, or of more, if it is noise; NaN where no test tells.
    known : bool
        Whether the size of the noise is known: sigma is, and is not far too large.
    freedom
        Values less unknowns; infinite where residuals are of no use.
    collapsed, at_bounds : int
        How many modes have collapsed, and how many unknowns are at bounds.
    smallest
        Smallest eigenvalue of the scaled Hessian; infinite if nothing is free.
    references : bool
        Whether there are reference signals among the data.
    """

    converged: NDArray[np.bool_]
    error: OfFits = 0.0
    lower: OfFits = 0
    tried: OfFits = 0
    agreeing: OfFits = 0
    explained: OfFits = np.nan
    probability: OfFits = np.nan
    known: OfFits = False
    freedom: OfFits = np.inf
    collapsed: OfFits = 0
    at_bounds: OfFits = 0
    smallest: OfFits = np.inf
    references: bool = False


class Doubt(NamedTuple):
    """One thing that speaks against some of R fits.

    Attributes
    ----------
    kind : str
        As of the reasons of a verdict.
    level : {"doubtful", "bad"}
    which : (R,) bool
    """

    kind: str
    level: Level
    which: NDArray[np.bool_]


def find_doubts(fits: Numbers) -> list[Doubt]:
    """Return what speaks against fits, in order of weight.

    Parameters
    ----------
    fits : Numbers
    """
    found = [doubt for doubt in _list_doubts(fits) if doubt.which.any()]
    return sorted(found, key=lambda doubt: -VERDICT_LEVELS.index(doubt.level))  # stable


def _list_doubts(fits: Numbers) -> Iterator[Doubt]:
    ended = fits.converged
    explained, probability, known = np.broadcast_arrays(fits.explained, fits.probability, fits.known, ended)[:3]
    tested, noise = ~np.isnan(probability), probability >= UNLIKELY_AS_NOISE
    share = np.where(tested & np.isnan(explained), noise, explained)  # of data that are 0 throughout
    exact = 1 - share < NO_RESIDUALS
    noise = noise | exact
    few = ended & (fits.freedom <= 0)
    judged = ended & ~few
    yield Doubt("not converged", "bad", ~ended)
    yield Doubt("integration error", "bad", ended & np.logical_not(fits.error <= FINE))
    yield Doubt("other starts are better", "bad", (fits.lower > 0) & ~exact)  # nothing is better than 0
    # Where noise of a known size is all that is left, no other end can be much lower. Otherwise two starts that agree
    # have to stand in for that.
    confirmed = noise & (known | exact | ((fits.agreeing >= 2) & (share >= NEARLY_ALL)))
    # A start that ended lower is a doubt of its own kind.
    lonely = (fits.lower == 0) & (fits.agreeing < AGREEING * fits.tried)
    yield Doubt("few starts agree", "doubtful", lonely & ~confirmed)
    unexplained = judged & (share < HALF) & ~noise
    no_noise = judged & (share >= HALF) & tested & ~noise
    wanted = np.where(noise, HALF, MOSTLY) if not fits.references else NEARLY_ALL
    # Only one finding about how much is explained: the weaker ones leave out what a stronger one has said.
    little = judged & (share < wanted) & ~known & ~unexplained & ~no_noise
    yield Doubt("unexplained", "bad", unexplained)
    yield Doubt("no noise", "doubtful", no_noise)
    yield Doubt("little explained", "doubtful", little)
    yield Doubt("too few samples", "doubtful", few)
    yield Doubt("a mode collapsed", "doubtful", ended & (fits.collapsed > 0))
    yield Doubt("at bounds", "doubtful", ended & (fits.at_bounds > 0))
    yield Doubt("not determined", "doubtful", ended & (fits.smallest < BARELY_DETERMINED))


def find_levels(doubts: list[Doubt], count: int) -> NDArray[np.str_]:
    """Return "good", "doubtful" or "bad" for each of so many fits: (R,).

    Parameters
    ----------
    doubts : list of Doubt
    count : int
    """
    places = np.zeros(count, dtype=int)
    for doubt in doubts:
        places[doubt.which] = np.maximum(places[doubt.which], VERDICT_LEVELS.index(doubt.level))
    return np.array(VERDICT_LEVELS)[places]
