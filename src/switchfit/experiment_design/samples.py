"""Choice of samples among candidates, by exchanges.

Each candidate adds its information. By the algorithm of Cook and Nachtsheim ([1]_), candidates are dropped one by one,
that which is missed least first, until as many are left as are allowed; then each of them is exchanged for the best
that is left out, until no exchange helps.

References
----------
.. [1] R. D. Cook, C. J. Nachtsheim, A comparison of algorithms for constructing exact D-optimal designs, Technometrics
   22 (1980) 315-324.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray

LEAST_GAIN_OF_EXCHANGE = 1e-9
"""An exchange must lower log m by more: equal candidates would be exchanged for ever."""


class Candidates(NamedTuple):
    """Samples that may be taken: the sensor of each (n,), its information (n, d, d), and that of all else (d, d)."""

    sensor: NDArray[np.intp]
    information: FloatArray
    others: FloatArray

    def add(self, taken: NDArray[np.bool_]) -> FloatArray:
        """Return the information with the candidates that are taken (n,)."""
        return self.others + self.information[taken].sum(0)


def choose_samples(
    candidates: Candidates, most: NDArray[np.intp], rate: Callable[[FloatArray], FloatArray]
) -> tuple[float, NDArray[np.bool_]]:
    """Return the lowest log m within a limit that no exchange of one sample improves, and the samples taken for it
    (n,).

    Parameters
    ----------
    candidates : Candidates
    most : (S,) int array
        Most samples of each sensor.
    rate : callable
        log m (...,) for information (..., d, d).
    """
    sensor, each = candidates.sensor, candidates.information
    taken = most[sensor] > 0
    # One at a time, since two samples that tell the same are both missed least until one of them is gone.
    while (over := np.flatnonzero(taken & (np.bincount(sensor, taken, len(most)) > most)[sensor])).size:
        taken[over[np.argmin(rate(candidates.add(taken) - each[over]))]] = False
    value, improved = float(rate(candidates.add(taken))), True
    while improved:
        improved = False
        # All exchanges of one sample in one call of `rate`. Of the same sensor: another would break a limit.
        for out in np.flatnonzero(taken):
            spare = np.flatnonzero(~taken & (sensor == sensor[out]))
            values = rate(candidates.add(taken) - each[out] + each[spare])
            if values.min(initial=np.inf) < value - LEAST_GAIN_OF_EXCHANGE:
                taken[out], taken[spare[np.argmin(values)]] = False, True
                value, improved = float(values.min()), True
    return value, taken
