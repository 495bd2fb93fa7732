"""Reference signals: functions of time that outputs of the trajectory are to follow, with an integrated cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import Converted, FloatArray
from switchfit.problem.dates import Dates
from switchfit.problem.samples import Observe, check_channels, check_samples, count_seconds
from switchfit.problem.signals import PiecewisePolynomial, filter_lowpass, fit_spline
from switchfit.problem.validation.arrays import as_array, as_positive
from switchfit.problem.validation.messages import shorten
from switchfit.problem.validation.objects import as_instance, set_fields
from switchfit.problem.validation.tables import find_labels
from switchfit.runtime.presentation import format_count, format_line, join_first


def _interpolate(given: FloatArray | Dates, values: FloatArray, lowpass_hz: float | None) -> PiecewisePolynomial:
    """Return the signal of samples (K,) and (K, q), broken at times that are given twice, and filtered if asked for."""
    # Dates have no unit before the experiment: until then the signal is in seconds, and not filtered.
    times = count_seconds(given) if isinstance(given, Dates) else given
    # A simulated trajectory jumps at a reset map: a spline across the jump would ring on both sides of it.
    cuts = np.flatnonzero(np.diff(times) == 0) + 1
    pieces = np.split(times, cuts)
    if (shortest := min(map(len, pieces))) < 4:
        raise ValueError(f"ReferenceSignal needs four samples or more in each part; got {shortest}.")
    parts = [fit_spline(*piece) for piece in zip(pieces, np.split(values, cuts), strict=True)]
    knots = np.concatenate([part.knots[:-1] for part in parts] + [times[-1:]])
    signal = PiecewisePolynomial(knots, np.concatenate([part.coefficients for part in parts]))
    return signal if lowpass_hz is None or isinstance(given, Dates) else filter_lowpass(signal, lowpass_hz)


@dataclass(frozen=True, eq=False)
class ReferenceSignal:
    """A continuous measured signal y_m(t): adds ``integral of 1/2 (y - y_m)' W (y - y_m) dt`` to J.

    The paper's cost (Section V) with ``y = observe(t, x, p)``. Build it with `from_samples`.

    Parameters
    ----------
    signal : PiecewisePolynomial or None
        y_m, with q channels; None: that of the samples.
    observe : callable ``h(t, x, p) -> (q,)``, optional
        If left out, the whole state is compared.
    weights : (q,) or (q, q) array_like, optional
        W, symmetric and positive semi-definite, or its diagonal; the identity if left out.
    names : sequence of str, optional
        One for each channel, for reports and plots.
    samples : (times, values), optional
        Samples from which the signal was made; times are dates until an experiment has converted them.
    lowpass_hz : float, optional
        Cut-off with which it was filtered.
    units : sequence of str, optional
        One for each channel.

    See Also
    --------
    Measurements : discrete samples.
    Experiment : takes it as `data`.

    Examples
    --------
    >>> times = np.linspace(0.0, 2.0, 41)
    >>> reference = sf.ReferenceSignal.from_samples(times, np.sin(times), lowpass_hz=2.0)
    >>> reference.signal.channels
    1
    """

    signal: Converted  # a PiecewisePolynomial
    observe: Observe | None = None
    weights: Converted = None  # W, (q, q)
    names: Sequence[str] | None = None
    samples: tuple[FloatArray | Dates, FloatArray] | None = None
    lowpass_hz: float | None = None
    units: Sequence[str] | None = None

    def __repr__(self) -> str:
        return format_line(self, join_first(self.names or ()), format_count(self.signal.channels, "channel"))

    def __post_init__(self) -> None:
        if self.signal is None and self.samples is not None:
            set_fields(self, signal=_interpolate(*self.samples, self.lowpass_hz))
        form = "made by sf.ReferenceSignal.from_samples(times, values, ...)"
        as_instance(self.signal, "signal of a ReferenceSignal", PiecewisePolynomial, form)
        check_channels(self, self.signal.channels, None, None)
        set_fields(self, weights=_build_weight_matrix(self.weights, self.signal.channels))

    @classmethod
    def from_samples(
        cls,
        times: ArrayLike,
        values: ArrayLike,
        *,
        observe: Observe | None = None,
        lowpass_hz: float | None = None,
        weights: ArrayLike | None = None,
        names: Sequence[str] | None = None,
        units: Sequence[str] | None = None,
    ) -> ReferenceSignal:
        """Interpolate samples by cubic splines and, optionally, low-pass filter them without phase shift.

        Parameters
        ----------
        times : (K,) array_like
            Increasing sample times in the experiment's time unit, or dates, which the experiment converts to it; four
            or more. The spline is broken at a time that is given twice, as at the transitions of a simulated
            trajectory; each part then needs four samples.
        values : (K,) or (K, q) array_like
            Times at which a value is NaN, which marks a missing one, are left out. Tables of pandas, polars and xarray,
            and a `Log`, bring their names and units.
        observe : callable ``h(t, x, p) -> (q,)``, optional
        lowpass_hz : float, optional
            Cut-off, in cycles per time unit of the experiment (Hz only if that is s), of a second-order Butterworth
            filter. It runs forward and backward over the interpolated signal, so that no phase shift remains (the gain
            at the cut-off is then 1/2).
        weights : (q,) or (q, q) array_like, optional
        names, units : sequence of str, optional

        Raises
        ------
        ValueError
            For bad times or values, fewer than four samples in a part, or a cut-off that is not positive or far
            above the sampling rate.
        TypeError
            If times are neither numbers nor dates, or values, weights or the cut-off are not numbers.

        See Also
        --------
        Measurements, Input

        Examples
        --------
        >>> times = np.linspace(0.0, 2.0, 41)
        >>> reference = sf.ReferenceSignal.from_samples(times, np.sin(times))
        >>> reference.signal([1.0]).round(6)
        array([[0.841471]])
        """
        found = find_labels(values)
        given, values = check_samples(times, values, "ReferenceSignal", at_least=4, breaks=True, missing=True)
        table = values.reshape(len(given), -1)
        known = ~np.isnan(table).any(axis=1)
        cutoff = None if lowpass_hz is None else as_positive(lowpass_hz, "lowpass_hz")
        names, units = (found[0] if names is None else names), (found[1] if units is None else units)
        return cls(None, observe, weights, names, (given[known], table[known]), cutoff, units)


def _build_weight_matrix(weights: ArrayLike | None, channels: int) -> FloatArray:
    """Return W as a symmetric positive semi-definite ``(q, q)`` matrix."""
    if weights is None:
        return np.eye(channels)
    matrix = as_array(weights, "weights", finite=True)
    if matrix.shape not in ((channels,), (channels, channels)):
        raise ValueError(f"weights must have shape ({channels},) or ({channels}, {channels}); got {matrix.shape}.")
    matrix = np.diag(matrix) if matrix.ndim == 1 else matrix
    is_symmetric = np.allclose(matrix, matrix.T, rtol=1e-12, atol=0.0)
    if not is_symmetric or np.linalg.eigvalsh(matrix)[0] < -1e-12 * np.abs(matrix).max():
        raise ValueError(f"weights must be symmetric and positive semi-definite; got {shorten(matrix.tolist())}.")
    return matrix
