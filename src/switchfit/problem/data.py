"""What J is made of: measurements with robust losses, reference signals, and other costs; and known inputs.

Signals in time are piecewise polynomials. Their knots are nodes of the mesh, so that the integrator never steps across
one, and the signal is one polynomial inside a step.

Robust losses: the cost of residuals that are larger than the noise explains.

With ``u = (r / sigma)**2`` and C the scale of the loss, a sample costs ``1/2 C**2 rho(u / C**2)``, as in
`scipy.optimize.least_squares` with ``f_scale = C``:

    linear    rho(z) = z
    soft_l1   rho(z) = 2 (sqrt(1 + z) - 1)
    huber     rho(z) = z for z <= 1, else 2 sqrt(z) - 1     (its second derivative jumps at z = 1)
    cauchy    rho(z) = log(1 + z)

Every function takes arrays of NumPy or JAX; `xp` is their module.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.problem.dates import FIRST, LENGTHS, Dates, Origin, list_dates, read_dates
from switchfit.problem.validation import (
    as_array,
    as_callable,
    as_choice,
    as_finite,
    as_instance,
    as_labels,
    as_name,
    as_named_columns,
    as_positive,
    find_labels,
    require_deviation,
    set_fields,
    shorten,
)
from switchfit.runtime.presentation import format_count, format_line, join_first

FloatArray = NDArray[np.float64]
Observe = Callable[..., Any]
"""``h(t, x, p) -> (q,)``: the output of a sensor."""

LOSSES = ("linear", "soft_l1", "huber", "cauchy")


def robust(loss: str, scale: float, u: Any, xp: Any = np) -> Any:
    """Return ``C**2 rho(u / C**2)``, which replaces u in the cost; the same shape.

    Parameters
    ----------
    loss : str, one of `LOSSES`
    scale : float
        C, in units of sigma.
    u : array
        Squared residuals, in units of sigma.
    """
    if loss == "linear":
        return u
    z = u / scale**2
    if loss == "cauchy":
        return scale**2 * xp.log1p(z)
    if loss == "soft_l1":
        return scale**2 * 2.0 * (xp.sqrt(1.0 + z) - 1.0)
    beyond = xp.where(z > 1.0, z, 1.0)  # the root of 0 has no derivative
    return scale**2 * xp.where(z > 1.0, 2.0 * xp.sqrt(beyond) - 1.0, z)


def influence(loss: str, scale: float, u: Any, xp: Any = np) -> Any:
    """Return ``rho'(u / C**2)``, between 0 and 1: the weight of a residual in the Gauss-Newton matrix;
    the same shape.
    """
    z = u / scale**2
    if loss == "cauchy":
        return 1.0 / (1.0 + z)
    if loss == "soft_l1":
        return 1.0 / xp.sqrt(1.0 + z)
    if loss == "huber":
        return 1.0 / xp.sqrt(xp.where(z > 1.0, z, 1.0))
    return xp.ones_like(z)


@dataclass(frozen=True, eq=False)
class RunningCost:
    """Incremental cost: adds ``integral of ell(t, x, p) dt`` over ``[t0, tf]`` to J, equation (2).

    Parameters
    ----------
    ell : callable ``ell(t, x, p) -> scalar``, twice differentiable in x and p.

    See Also
    --------
    TerminalCost, TransitionCost, ReferenceSignal

    Examples
    --------
    >>> import switchfit as sf
    >>> effort = sf.RunningCost(lambda t, x, p: x[0] ** 2)
    >>> run = sf.Experiment(effort, ("on", "off"), (2.0,), 0.0, 4.0)
    >>> len(run.data)
    1
    """

    ell: Callable[..., Any]

    def __post_init__(self) -> None:
        as_callable(self.ell, "RunningCost", "a function ell(t, x, p)")


@dataclass(frozen=True, eq=False)
class TerminalCost:
    """Cost of the final state: adds ``phi(x(tf), p)`` to J.

    Parameters
    ----------
    phi : callable ``phi(x, p) -> scalar``, twice differentiable.

    See Also
    --------
    RunningCost, TransitionCost, TerminalConstraint

    Examples
    --------
    >>> import switchfit as sf
    >>> far = sf.TerminalCost(lambda x, p: -x[0])
    >>> run = sf.Experiment(far, ("go",), (), 0.0, 1.0)
    >>> len(run.data)
    1
    """

    phi: Callable[..., Any]

    def __post_init__(self) -> None:
        as_callable(self.phi, "TerminalCost", "a function phi(x, p)")


@dataclass(frozen=True, eq=False)
class TransitionCost:
    """Cost of a transition: adds ``mu(tau, x(tau-), p)`` to J at each transition between two modes.

    tau is the transition time, and x(tau-) the state just before it, before any reset map. Use it for the cost of a
    switch, a penalty on its distance from a desired state or time, or a prior that depends on the state.

    Parameters
    ----------
    mu : callable ``mu(t, x, p) -> scalar``, twice differentiable.
    before, after : str, optional
        The modes between which it counts; any mode if left out. No two may count at the same transition.

    See Also
    --------
    RunningCost, TerminalCost

    Examples
    --------
    Switching from "push" to "brake" costs the square of the speed:

    >>> import switchfit as sf
    >>> cost = sf.TransitionCost(lambda t, x, p: x[1] ** 2, before="push", after="brake")
    """

    mu: Callable[..., Any]
    before: str | None = None
    after: str | None = None

    def __post_init__(self) -> None:
        as_callable(self.mu, "TransitionCost", "a function mu(t, x, p)")
        for name in ("before", "after"):
            if getattr(self, name) is not None:
                as_name(getattr(self, name), name, "the name of a mode")


@dataclass(frozen=True, eq=False)
class TerminalConstraint:
    """Equality constraint on the final state: ``psi(x(tf), p) = 0``.

    Parameters
    ----------
    psi : callable ``psi(x, p) -> () or (m,)``, twice differentiable.

    See Also
    --------
    TerminalCost, HybridSystem

    Examples
    --------
    >>> import switchfit as sf

    The speed has to be zero at the end:

    >>> at_rest = sf.TerminalConstraint(lambda x, p: x[1])
    >>> run = sf.Experiment([sf.TerminalCost(lambda x, p: -x[0]), at_rest], ("go",), (), 0.0, 1.0)
    >>> len(run.data)
    2
    """

    psi: Callable[..., Any]

    def __post_init__(self) -> None:
        as_callable(self.psi, "TerminalConstraint", "a function psi(x, p)")


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

    def interval(self, times: FloatArray) -> NDArray[np.intp]:
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
    padding = int(min(len(grid) - 1, np.ceil(3 * rate / cutoff_hz)))
    filtered = scipy.signal.sosfiltfilt(sos, signal(grid), axis=0, padtype="odd", padlen=padding)
    return fit_spline(grid, filtered)


def _interpolate(given: Any, values: FloatArray, lowpass_hz: float | None) -> PiecewisePolynomial:
    """Return the signal of samples (K,) and (K, q), broken at times that are given twice, and filtered if asked for."""
    # Dates have no unit before the experiment: until then the signal is in seconds, and not filtered.
    times = _count_seconds(given) if isinstance(given, Dates) else given
    cuts = np.flatnonzero(np.diff(times) == 0) + 1
    pieces = np.split(times, cuts)
    if (shortest := min(map(len, pieces))) < 4:
        raise ValueError(f"ReferenceSignal needs four samples or more in each part; got {shortest}.")
    parts = [fit_spline(*piece) for piece in zip(pieces, np.split(values, cuts), strict=True)]
    knots = np.concatenate([part.knots[:-1] for part in parts] + [times[-1:]])
    signal = PiecewisePolynomial(knots, np.concatenate([part.coefficients for part in parts]))
    return signal if lowpass_hz is None or isinstance(given, Dates) else filter_lowpass(signal, lowpass_hz)


@dataclass(frozen=True, eq=False)
class Input:
    """A known input ``u(t)``, given by samples; the modes are then functions ``f(t, x, p, u)``.

    Parameters
    ----------
    times : (K,) array_like
        Increasing times in the experiment's time unit, or dates, which the experiment converts to it. They must cover
        its ``[t0, tf]``; for a held input it is enough to start by t0, as its last value is held.
    values : (K,) or (K, q) array_like, or mapping of str to (K,) array_like
        The modes get a scalar u, or a ``(q,)`` array. With samples by name they get a dict of scalars, ``u["left"]``;
        likewise with a table whose columns all have names (strings): a DataFrame of pandas or polars, a Dataset of
        xarray, a `Log`.
    kind : {"hold", "linear", "cubic"}
        Interpolation between samples: hold the last value, straight lines, or a cubic spline.
    units : sequence of str, optional
        One for each entry of u, in the order of `names` if they have names. If left out, those of the table, from its
        ``attrs["units"]``.

    Raises
    ------
    ValueError
        For times that do not increase, values that are not finite or differ in length from times, too few
        samples, no name or an empty one, or an unknown kind.
    TypeError
        If times are neither numbers nor dates, values are not numbers, or a name is not a string.

    See Also
    --------
    Experiment : takes it as `inputs`.
    ReferenceSignal : a measured signal to which the model is fitted.

    Examples
    --------
    >>> import numpy as np
    >>> import switchfit as sf
    >>> wheels = sf.Input([0.0, 1.0, 2.0], {"left": [0.0, 4.0, 4.0], "right": [0.0, 4.0, 5.0]}, kind="linear")
    >>> wheels.names
    ('left', 'right')

    A mode of an experiment with ``inputs=wheels`` reads each of them by its name:

    >>> def drive(t, x, p, u):
    ...     return p["r"] * np.array([0.5, 0.5]) @ [u["left"], u["right"]]
    """

    times: Any
    values: Any
    kind: Literal["hold", "linear", "cubic"] = "hold"
    units: Sequence[str] | None = None

    def __repr__(self) -> str:
        return format_line(self, join_first(self.names or ()), self.kind, format_count(len(self.times), "time"))

    def __post_init__(self) -> None:
        kind = as_choice(self.kind, "Input kind", ("hold", "linear", "cubic"))
        at_least = {"hold": 1, "linear": 2, "cubic": 4}[kind]
        named = as_named_columns(self.values, "Input values", "(K,) samples")
        values: dict[str, FloatArray] = {}
        # Sorted, so that experiments whose inputs are named in different orders share one program.
        for name in [""] if named is None else sorted(named):
            what, given = ("Input", self.values) if named is None else (f"Input {shorten(name)}", named[name])
            times, values[name] = _check_samples(self.times, given, what, at_least=at_least, columns=named is None)
        units, (_, found) = self.units, find_labels(self.values)
        if units is None and found is not None:
            units = found if named is None else tuple(unit for _, unit in sorted(zip(named, found, strict=True)))
        set_fields(self, kind=kind, times=times, values=values[""] if named is None else values)
        set_fields(self, units=as_labels(units, "units", "channel", int(np.prod(self.shape))))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the entries of u, sorted; empty if u is a scalar or an array."""
        return tuple(self.values) if isinstance(self.values, Mapping) else ()

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of u: () or (q,). If its entries have names, q is their number."""
        return (len(self.values),) if self.names else tuple(self.values.shape[1:])

    def signal(self, t0: float, tf: float) -> PiecewisePolynomial:
        """Return the input as a piecewise polynomial over ``[t0, tf]``.

        See Also
        --------
        Input

        Examples
        --------
        >>> import switchfit as sf
        >>> signal = sf.Input([0.0, 1.0], [0.0, 4.0], kind="linear").signal(0.0, 1.0)
        >>> signal([0.25, 0.5])
        array([[1.],
               [2.]])
        """
        times = self.times
        values = np.stack([self.values[name] for name in self.names], axis=1) if self.names else self.values
        values = values.reshape(len(times), -1)
        if times[0] > t0 or (self.kind != "hold" and times[-1] < tf):
            raise ValueError(
                f"Input must be known over (t0, tf) = ({t0}, {tf}); its samples reach from {times[0]} to {times[-1]}."
            )
        if self.kind == "cubic":
            return fit_spline(times, values)
        if self.kind == "hold":
            times, values = np.append(times, max(tf, times[-1] + 1.0)), np.append(values, values[-1:], axis=0)
        coefficients = np.zeros((len(times) - 1, 4, values.shape[1]))
        coefficients[:, 0] = values[:-1]
        if self.kind == "linear":
            with np.errstate(all="ignore"):
                coefficients[:, 1] = np.diff(values, axis=0) / np.diff(times)[:, None]
        return PiecewisePolynomial(times, coefficients)


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
    >>> import numpy as np
    >>> import switchfit as sf
    >>> times = np.linspace(0.0, 2.0, 41)
    >>> reference = sf.ReferenceSignal.from_samples(times, np.sin(times), lowpass_hz=2.0)
    >>> reference.signal.channels
    1
    """

    signal: Any
    observe: Observe | None = None
    weights: Any = None
    names: Sequence[str] | None = None
    samples: tuple[Any, FloatArray] | None = None
    lowpass_hz: float | None = None
    units: Sequence[str] | None = None

    def __repr__(self) -> str:
        return format_line(self, join_first(self.names or ()), format_count(self.signal.channels, "channel"))

    def __post_init__(self) -> None:
        if self.signal is None and self.samples is not None:
            set_fields(self, signal=_interpolate(*self.samples, self.lowpass_hz))
        form = "made by sf.ReferenceSignal.from_samples(times, values, ...)"
        as_instance(self.signal, "signal of a ReferenceSignal", PiecewisePolynomial, form)
        _check_channels(self, self.signal.channels, None, None)
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
        >>> import numpy as np
        >>> import switchfit as sf
        >>> times = np.linspace(0.0, 2.0, 41)
        >>> reference = sf.ReferenceSignal.from_samples(times, np.sin(times))
        >>> reference.signal([1.0]).round(6)
        array([[0.841471]])
        """
        found = find_labels(values)
        given, values = _check_samples(times, values, "ReferenceSignal", at_least=4, breaks=True, missing=True)
        table = values.reshape(len(given), -1)
        known = ~np.isnan(table).any(axis=1)
        cutoff = None if lowpass_hz is None else as_positive(lowpass_hz, "lowpass_hz")
        names, units = (found[0] if names is None else names), (found[1] if units is None else units)
        return cls(None, observe, weights, names, (given[known], table[known]), cutoff, units)


@dataclass(frozen=True, eq=False)
class Measurements:
    """Discrete noisy samples: adds ``1/2 sum ((y_k - h(t_k, x(t_k), p)) / sigma)**2`` to J.

    With a sigma that is a parameter, ``sum log sigma`` over its samples is added too, so that J is the negative
    logarithm of the likelihood up to a constant. With a robust loss, ``1/2 C**2 rho((r / sigma)**2 / C**2)`` replaces
    each ``1/2 (r / sigma)**2``, where C is the `loss_scale` (`switchfit.problem.data`).

    Parameters
    ----------
    times : (K,) array_like
        Increasing sample times in the experiment's time unit, or dates, which the experiment converts to it: text in
        ISO 8601, datetime, datetime64, columns of pandas, polars or xarray, `Log.dates`, or what `from_epoch` returns.
        They may be irregular. What was measured again at the same time goes into a second `Measurements`.
    values : (K,) or (K, q) array_like
        Samples; NaN marks a missing one. Tables of pandas, polars and xarray, and a `Log`, bring their names and units.
        For an `OnlineEstimator` there may be none yet: ``np.empty((0, q))``.
    observe : callable ``h(t, x, p) -> (q,)``, optional
        If left out, the whole state is measured. At a transition with a reset map, the sample is of the state
        just before the jump.
    sigma : float, (q,) or (K, q) array_like, str, or list of float and str, optional
        Standard deviation of the noise, for all, for each channel or for each sample. A string is the name of a
        parameter, whose value is sigma: for all channels, or in a list of q entries for one of them. If left out, sigma
        is unknown: all samples have weight 1, and the covariance is scaled by the residual variance.
    names : sequence of str, optional
        One for each channel; if left out, those of the table.
    loss : {"linear", "soft_l1", "huber", "cauchy"}, optional
        As in `scipy.optimize.least_squares`; all but the first reduce the weight of outliers.
    loss_scale : float, optional
        C, in units of sigma: residuals beyond it are outliers.
    delay : float or str, optional
        Delay of the sensor, in the experiment's time unit: a sample with time stamp t_k is of the state at
        ``t_k - delay``, and `observe` is called with that time. A string is the name of a parameter, whose value is the
        delay. Give channels with different delays as several `Measurements`.
    units : sequence of str, optional
        One for each channel; if left out, those of the table, from its ``attrs["units"]``.

    Raises
    ------
    ValueError
        For times that do not increase, shapes that do not match, no sample and no channels, infinite values, a
        sigma that is not positive, an unknown loss, or a robust loss without sigma.
    TypeError
        If times are neither numbers nor dates, or values, sigma or another number is not a number.

    See Also
    --------
    ReferenceSignal : a continuous signal.
    Experiment : takes it as `data`.

    Examples
    --------
    >>> import numpy as np
    >>> import switchfit as sf

    Two channels of a state of three, one value missing, with noise of different size:

    >>> gps = sf.Measurements(
    ...     [0.0, 0.5, 1.0],
    ...     [[0.0, 1.0], [np.nan, 1.2], [0.4, 1.3]],
    ...     observe=lambda t, x, p: x[np.array([0, 2])],
    ...     sigma=[0.1, 0.2],
    ...     names=("X", "Y"),
    ... )
    >>> gps.count
    5
    """

    times: Any
    values: Any
    observe: Observe | None = None
    sigma: Any = None
    names: Sequence[str] | None = None
    loss: Literal["linear", "soft_l1", "huber", "cauchy"] = "linear"
    loss_scale: float = 1.0
    delay: float | str = 0.0
    units: Sequence[str] | None = None

    def __repr__(self) -> str:
        channels = join_first(self.names) if self.names else format_count(self.values.shape[1], "channel")
        return format_line(self, channels, format_count(len(self.times), "time"))

    def __post_init__(self) -> None:
        found = find_labels(self.values)
        times, values = _check_samples(self.times, self.values, "Measurements", at_least=0, missing=True)
        values = values[:, None] if values.ndim == 1 else values
        if len(values) and np.isnan(values).all():
            raise ValueError("Measurements values are all NaN: there is nothing to fit.")
        set_fields(self, times=times, values=values, sigma=_check_sigma(self.sigma, values))
        _check_channels(self, values.shape[1], *found)
        self._check_loss()
        set_fields(self, delay=_read_number_or_name(self.delay, "delay"))

    @property
    def seen_times(self) -> FloatArray:
        """Times of the states that were measured, (K,); a delay that is a parameter is not subtracted."""
        return self.times if isinstance(self.delay, str) or self.delay == 0.0 else self.times - self.delay

    def _check_loss(self) -> None:
        loss = as_choice(self.loss, "loss", LOSSES)
        scale = as_positive(self.loss_scale, "loss_scale")
        if not 0 < scale * scale < np.inf:
            raise ValueError(f"loss_scale must have a square that is neither 0 nor infinite; got {scale}.")
        set_fields(self, loss=loss, loss_scale=scale)
        if self.loss != "linear" and self.sigma is None:
            raise ValueError(
                f"loss={self.loss!r} measures residuals in units of sigma: give it, or the name of a parameter for it."
            )
        if self.loss == "cauchy" and self.sigma_names and scale <= 1:
            raise ValueError(
                f"loss='cauchy' with an estimated sigma needs a loss_scale above 1, or sigma vanishes; got {scale}."
            )

    @property
    def sigma_names(self) -> tuple[str | None, ...]:
        """The parameter that is the sigma of each channel, None for a number; empty if all are numbers."""
        if not isinstance(self.sigma, tuple):
            return ()
        return tuple(entry if isinstance(entry, str) else None for entry in self.sigma)

    def noise(self, parameters: Mapping[str, Any]) -> FloatArray | None:
        """Return the standard deviation of each sample, a (K, q) array, given the model's parameters; None if it is
        unknown.

        See Also
        --------
        Measurements

        Examples
        --------
        >>> import switchfit as sf
        >>> log = sf.Measurements([0.0, 1.0], [2.0, 3.0], sigma="noise")
        >>> log.noise({"noise": 0.5})
        array([[0.5],
               [0.5]])
        """
        if self.sigma is None:
            return None
        sigma = self.sigma
        if isinstance(sigma, tuple):
            sigma = np.array([float(parameters[s]) if isinstance(s, str) else s for s in sigma])
        return np.broadcast_to(sigma, self.values.shape).copy()

    @property
    def weights(self) -> FloatArray:
        """``1 / sigma**2`` (1 if sigma is unknown or a parameter), 0 for missing samples: (K, q)."""
        sigma = self.noise(dict.fromkeys(filter(None, self.sigma_names), 1.0))
        inverse = np.ones(self.values.shape) if sigma is None else sigma**-2.0
        return np.where(np.isnan(self.values), 0.0, inverse)

    @property
    def count(self) -> int:
        """Number of values that are not missing."""
        return int(np.count_nonzero(~np.isnan(self.values)))


Data = Measurements | ReferenceSignal | RunningCost | TransitionCost | TerminalCost | TerminalConstraint


def count_from(item: Any, origin: Origin, time_unit: str, what: str = "") -> Any:
    """Return what an experiment is given, dates as numbers of a unit since the origin; anything else as it is.

    Parameters
    ----------
    item : data, input, jump, time or `Parameter`, or a tuple of these
    origin : Origin
    time_unit : str
    what : str, optional
        What messages call it; of data, inputs and jumps their times.
    """
    if isinstance(item, tuple):
        return tuple(count_from(entry, origin, time_unit, what) for entry in item)
    if isinstance(item, Dates):
        return origin.to_numbers(item, time_unit, what)
    if not any(list_dates(item)):
        return item
    what = what or f"times of {type(item).__name__}"
    own = {each.name: count_from(getattr(item, each.name), origin, time_unit, what) for each in fields(item)}
    return replace(item, **own | ({"signal": None} if isinstance(item, ReferenceSignal) else {}))


def _check_samples(
    times: Any,
    values: Any,
    what: str,
    *,
    at_least: int,
    breaks: bool = False,
    missing: bool = False,
    columns: bool = True,
) -> tuple[Any, FloatArray]:
    """Return times (K,) and values (K,) or (K, q) as float64, checked against each other; dates remain dates.

    With `breaks`, a time may occur twice; with `missing`, values may be NaN; without
    `columns`, the shape of the values must be (K,).
    """
    dates = read_dates(times, f"{what} times")
    form = "an array of numbers"
    times = as_array(times, f"{what} times", form=form, finite=True) if dates is None else _count_seconds(dates)
    values = as_array(values, f"{what} values", form=form, finite=not missing)
    if values.ndim not in ((1, 2) if columns else (1,)) or times.shape != values.shape[:1]:
        raise ValueError(
            f"{what} needs times of shape (K,) and values of shape (K,){' or (K, q)' if columns else ''}; "
            f"got {times.shape} and {values.shape}."
        )
    if len(times) < at_least or not values.shape[-1]:
        raise ValueError(f"{what} needs {max(at_least, 1)} sample(s) or more; got {len(times)}.")
    if np.isinf(values).any():
        raise ValueError(f"{what} values must be finite, or NaN where a sample is missing; got infinity.")
    wrong = np.diff(times) <= 0
    if breaks:
        wrong = (np.diff(times) < 0) | np.append(times[2:] == times[:-2], False)
    if wrong.any():
        k = int(np.argmax(wrong))
        shown = times if dates is None else dates
        is_repeated = what == "Measurements" and times[k] == times[k + 1]
        advice = " Samples of the same time go into a second Measurements of the experiment." if is_repeated else ""
        raise ValueError(
            f"{what} times must increase strictly; got {shown[k]} followed by {shown[k + 1]} at index {k + 1}.{advice}"
        )
    times.flags.writeable = False
    values.flags.writeable = False
    return times if dates is None else dates, values


def _count_seconds(dates: Dates) -> FloatArray:
    """Return the seconds since the first of dates."""
    first = dates.instants.min() if dates.instants.size else FIRST
    return np.asarray((dates.instants - first) / LENGTHS["s"])


def _check_channels(item: Measurements | ReferenceSignal, q: int, names: Any, units: Any) -> None:
    """Check the function that makes q channels; set their names and units, those of a table where they are left out."""
    if item.observe is not None:
        as_callable(item.observe, "observe", "a function h(t, x, p)")
    for label, found in (("names", names), ("units", units)):
        given = getattr(item, label)
        set_fields(item, **{label: as_labels(found if given is None else given, label, "channel", q)})


def _read_number_or_name(value: Any, what: str) -> float | str:
    """Return a finite number, or the name of the parameter that it is."""
    if isinstance(value, str):
        return as_name(value, what)
    return as_finite(value, f"{what} (a number, or the name of a parameter)")


def _check_sigma(sigma: Any, values: FloatArray) -> FloatArray | tuple[str | float, ...] | None:
    """Return sigma of values (K, q), checked; that of a missing value may be missing too, and becomes 1."""
    shape = values.shape
    if sigma is None:
        return None
    if isinstance(sigma, str):
        sigma = [sigma] * shape[1]
    if isinstance(sigma, (list, tuple)) and any(isinstance(entry, str) for entry in sigma):
        if len(sigma) != shape[1]:
            raise ValueError(f"sigma must have one entry for each of the {shape[1]} channels; got {shorten(sigma)}.")
        entries = tuple(_read_number_or_name(entry, "sigma") for entry in sigma)
        require_deviation(np.array([entry for entry in entries if not isinstance(entry, str)]), "sigma")
        return entries
    sigma = as_array(sigma, "sigma")
    if sigma.shape not in ((), (shape[1],), shape) or not sigma.size:
        raise ValueError(
            f"sigma must be a number, of shape ({shape[1]},) (one per channel) or {shape} (one per sample); "
            f"got shape {sigma.shape}."
        )
    if sigma.shape == shape:
        sigma = np.where(np.isnan(sigma) & np.isnan(values), 1.0, sigma)
        if np.isnan(sigma).any():
            where = np.argwhere(np.isnan(sigma))[0].tolist()
            raise ValueError(f"sigma must be positive and finite; it is NaN at index {where}, and the value is not.")
    require_deviation(sigma, "sigma")
    return sigma


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
