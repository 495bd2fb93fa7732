"""Known inputs u(t) of the modes, given by samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from switchfit.arrays import Converted, FloatArray
from switchfit.problem.samples import check_samples
from switchfit.problem.signals import PiecewisePolynomial, fit_spline
from switchfit.problem.validation.messages import shorten
from switchfit.problem.validation.names import as_choice, as_labels, as_named_columns
from switchfit.problem.validation.objects import set_fields
from switchfit.problem.validation.tables import find_labels
from switchfit.runtime.presentation import format_count, format_line, join_first


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
    >>> wheels = sf.Input([0.0, 1.0, 2.0], {"left": [0.0, 4.0, 4.0], "right": [0.0, 4.0, 5.0]}, kind="linear")
    >>> wheels.names
    ('left', 'right')

    A mode of an experiment with ``inputs=wheels`` reads each of them by its name:

    >>> def drive(t, x, p, u):
    ...     return p["r"] * np.array([0.5, 0.5]) @ [u["left"], u["right"]]
    """

    times: Converted  # (K,), or `Dates` until an experiment has counted them from its origin
    values: Converted  # (K,) or (K, q), or a dict of (K,) by name
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
            times, values[name] = check_samples(self.times, given, what, at_least=at_least, columns=named is None)
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
        # The last value is held to tf: one more knot, and behind the last sample if tf comes before it.
        if self.kind == "hold":
            times, values = np.append(times, max(tf, times[-1] + 1.0)), np.append(values, values[-1:], axis=0)
        coefficients = np.zeros((len(times) - 1, 4, values.shape[1]))
        coefficients[:, 0] = values[:-1]
        if self.kind == "linear":
            with np.errstate(all="ignore"):
                coefficients[:, 1] = np.diff(values, axis=0) / np.diff(times)[:, None]
        return PiecewisePolynomial(times, coefficients)
