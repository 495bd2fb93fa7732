"""Values of the parameters at which a search for the mode sequence begins."""

from __future__ import annotations

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.modes.fitter import Fitter

FACTORS = (0.7, 1.4)
"""By which a guess without a prior is multiplied."""

MOST_ALONE = 4
"""Parameters up to which each is changed alone too."""


def propose_starts(fitter: Fitter) -> list[FloatArray]:
    """Return the guess, then all parameters lower and higher together, then each alone: (M,) arrays.

    Lower and higher is one standard deviation of a prior, or a factor of 0.7 and 1.4. Parameters that are 0 without a
    prior stay.
    """
    guess, (lower, upper) = fitter.start, fitter.bounds
    priors = fitter.problem.unknowns.priors
    precision, log = priors.precision[fitter.first :], priors.log[fitter.first :]
    with np.errstate(divide="ignore"):
        sd = np.where(precision > 0, precision**-0.5, 0.0)
    changed = []
    for factor, sign in zip(FACTORS, (-1, 1), strict=True):
        # A prior says how far off a guess may be; a factor is for guesses of which nothing is known.
        by_prior = np.where(log, guess * np.exp(sign * sd), guess + sign * sd)
        changed.append(np.clip(np.where(precision > 0, by_prior, factor * guess), lower, upper))
    starts = [guess, *changed]
    if 1 < len(guess) <= MOST_ALONE:
        places = np.arange(len(guess))
        starts += [np.where(places == i, moved, guess) for i in places for moved in changed]
    # Fixed bounds, and zeros, make starts equal: each is searched from once.
    return list({start.tobytes(): start for start in starts}.values())
