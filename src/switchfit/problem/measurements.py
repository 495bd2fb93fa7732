"""Measurements: samples of outputs at known times, with their noise, robust loss and delay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from switchfit.arrays import Converted, FloatArray
from switchfit.problem.losses import LOSSES
from switchfit.problem.samples import Observe, check_channels, check_samples
from switchfit.problem.validation.arrays import as_array, as_finite, as_positive, require_deviation
from switchfit.problem.validation.messages import shorten
from switchfit.problem.validation.names import as_choice, as_name
from switchfit.problem.validation.objects import set_fields
from switchfit.problem.validation.tables import find_labels
from switchfit.runtime.presentation import format_count, format_line, join_first


@dataclass(frozen=True, eq=False)
class Measurements:
    """Discrete noisy samples: adds ``1/2 sum ((y_k - h(t_k, x(t_k), p)) / sigma)**2`` to J.

    With a sigma that is a parameter, ``sum log sigma`` over its samples is added too, so that J is the negative
    logarithm of the likelihood up to a constant. With a robust loss, ``1/2 C**2 rho((r / sigma)**2 / C**2)`` replaces
    each ``1/2 (r / sigma)**2``, where C is the `loss_scale` (`switchfit.problem.losses`).

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

    times: Converted  # (K,), or `Dates` until an experiment has counted them from its origin
    values: Converted  # (K, q), NaN where a sample is missing
    observe: Observe | None = None
    sigma: Converted = None  # an array, or a tuple of q numbers and names of parameters, or None
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
        times, values = check_samples(self.times, self.values, "Measurements", at_least=0, missing=True)
        # One channel has shape (K, 1) from here on: nothing below tells (K,) from (K, q).
        values = values[:, None] if values.ndim == 1 else values
        if len(values) and np.isnan(values).all():
            raise ValueError("Measurements values are all NaN: there is nothing to fit.")
        set_fields(self, times=times, values=values, sigma=_check_sigma(self.sigma, values))
        check_channels(self, values.shape[1], *found)
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
        # The cost of a sample grows like C**2 log(r / sigma) and log sigma falls: with C <= 1 their sum has no minimum
        # above 0.
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

    def noise(self, parameters: Mapping[str, float | FloatArray]) -> FloatArray | None:
        """Return the standard deviation of each sample, a (K, q) array, given the model's parameters; None if it is
        unknown.

        See Also
        --------
        Measurements

        Examples
        --------
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
        # 1 in place of a sigma that is a parameter: the program multiplies by 1 / sigma**2 itself.
        inverse = np.ones(self.values.shape) if sigma is None else sigma**-2.0
        return np.where(np.isnan(self.values), 0.0, inverse)

    @property
    def count(self) -> int:
        """Number of values that are not missing."""
        return int(np.count_nonzero(~np.isnan(self.values)))


def _read_number_or_name(value: object, what: str) -> float | str:
    """Return a finite number, or the name of the parameter that it is."""
    if isinstance(value, str):
        return as_name(value, what)
    return as_finite(value, f"{what} (a number, or the name of a parameter)")


def _check_sigma(sigma: object, values: FloatArray) -> FloatArray | tuple[str | float, ...] | None:
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
    # Sigma for each sample, from a table whose rows may miss the value and its sigma together.
    if sigma.shape == shape:
        sigma = np.where(np.isnan(sigma) & np.isnan(values), 1.0, sigma)
        if np.isnan(sigma).any():
            where = np.argwhere(np.isnan(sigma))[0].tolist()
            raise ValueError(f"sigma must be positive and finite; it is NaN at index {where}, and the value is not.")
    require_deviation(sigma, "sigma")
    return sigma
