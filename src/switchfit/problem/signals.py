"""Signals in time as piecewise polynomials: interpolation of samples, and low-pass filters.

The knots of a signal are nodes of the mesh, so that the integrator never steps across one, and the signal is one
polynomial inside a step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray, IntArray

MOST_FILTERED = 10**7
"""Largest number of points at which a signal is filtered."""

OVERFLOW = (
    "The signal between the samples of an Input or a ReferenceSignal overflows: values must be smaller, or times "
    "further apart."
)

LOWEST_CUTOFF = 1e-6
"""Smallest cut-off of a low-pass filter, in cycles per point. At 1e-8 its output is off by 3 %; below, errors are
unbounded."""


@dataclass(frozen=True, eq=False)
class PiecewisePolynomial:
    """A signal that is a cubic between knots: ``sum_i coefficients[k, i] (t - knots[k])**i`` from knot k on.

    Attributes
    ----------
    knots : (K,) array, increasing
    coefficients : (K - 1, 4, q) array, lowest power first
    """

    knots: FloatArray
    coefficients: FloatArray

    def __post_init__(self) -> None:
        if not np.isfinite(self.coefficients).all():
            raise ValueError(OVERFLOW)

    @property
    def channels(self) -> int:
        """Number of channels, q."""
        return int(self.coefficients.shape[2])

    def interval(self, times: FloatArray) -> IntArray:
        """Return the index of the knot interval that holds each of `times`; beyond the ends, the first or the last."""
        return self.knots[1:-1].searchsorted(times, side="right")

    def __call__(self, times: ArrayLike) -> FloatArray:
        """Values at `times` (K,): a ``(K, q)`` array."""
        times = np.asarray(times, dtype=np.float64)
        k = self.interval(times)
        s = (times - self.knots[k])[:, None]
        c = self.coefficients[k]
        return c[:, 0] + s * (c[:, 1] + s * (c[:, 2] + s * c[:, 3]))


def fit_spline(times: FloatArray, values: FloatArray) -> PiecewisePolynomial:
    """Return the not-a-knot cubic spline through samples.

    Parameters
    ----------
    times : (K,)
    values : (K, q)
    """
    from scipy.interpolate import CubicSpline  # here, since importing it takes longer than most fits

    try:
        with np.errstate(all="ignore"):
            spline = CubicSpline(times, values, axis=0)
    except ValueError:  # times and values are finite, but their slopes are not
        raise ValueError(OVERFLOW) from None
    return PiecewisePolynomial(times, np.moveaxis(spline.c[::-1], 0, 1))


def filter_lowpass(signal: PiecewisePolynomial, cutoff_hz: float) -> PiecewisePolynomial:
    """Filter a signal by a second-order Butterworth filter, forward and backward, on a grid of ten points per period of
    the cut-off.

    Parameters
    ----------
    signal : PiecewisePolynomial
    cutoff_hz : float
        In cycles per unit of time.
    """
    import scipy.signal  # here, since importing it takes longer than most fits

    start, end = signal.knots[[0, -1]].tolist()
    # Ten points a period of the cut-off, and no fewer than the samples: coarser ones would fold noise into the band.
    step = min(0.1 / cutoff_hz, float(np.median(np.diff(signal.knots))))
    if not (end - start) * max(10 * cutoff_hz, 1 / step) <= MOST_FILTERED:
        raise ValueError(f"lowpass_hz must not need more than {MOST_FILTERED} points, ten a period; got {cutoff_hz:g}.")
    grid = np.linspace(start, end, max(int(np.ceil((end - start) / step)) + 1, 8))
    rate = (len(grid) - 1) / (end - start)
    if cutoff_hz < LOWEST_CUTOFF * rate:
        raise ValueError(
            f"lowpass_hz must be {LOWEST_CUTOFF * rate:.3g} or more, else all is rounding error; got {cutoff_hz:g}."
        )
    sos = scipy.signal.butter(2, cutoff_hz, fs=rate, output="sos")
    # Three periods of the cut-off, reflected at the ends: transients of the filter decay there and not in the data.
    padding = int(min(len(grid) - 1, np.ceil(3 * rate / cutoff_hz)))
    filtered = scipy.signal.sosfiltfilt(sos, signal(grid), axis=0, padtype="odd", padlen=padding)
    return fit_spline(grid, filtered)
