"""Numbers and units as text.

A number is rounded to the two significant digits of its standard error; the unit "1" of a pure number is not shown.
"""

from __future__ import annotations

import textwrap

import numpy as np

from switchfit.fit.comparison import Comparison
from switchfit.fit.trajectory import Trajectory


def format_rounded(value: float, error: float) -> tuple[str, str, str]:
    """Return value, "± error" and "(relative error)" as text, the value to the two significant digits of its error.

    Parameters
    ----------
    value, error : float
        An error that is NaN is left away; one of 0 says that the value is held.
    """
    # Without an error there is nothing to round to: eight digits, and "held" where the error is known to be 0.
    if not np.isfinite(error) or error <= 0.0 or not np.isfinite(value):
        return f"{value:.8g}", "held" if error == 0.0 else "", ""
    last = 1 - _find_exponent(error)  # decimal place of the second digit of the error
    if value != 0.0:
        last = max(last, 1 - _find_exponent(value))
    # A ratio to a value near 0 is large and says nothing.
    relative = f"({100 * error / abs(value):.2g} %)" if abs(value) > error / 10 else ""
    if 1e-4 <= max(abs(value), error) < 1e7:
        return f"{value:.{max(last, 0)}f}", f"± {error:.{max(last, 0)}f}", relative
    # The same decimal place, counted from the first digit of the value.
    digits = max(last + _find_exponent(value), 1) if value != 0.0 else 1
    return f"{value:.{digits}e}", f"± {error:.1e}", relative


def _find_exponent(number: float) -> int:
    return int(np.floor(np.log10(abs(number))))


def format_unit(unit: str) -> str:
    """Return a unit as it is shown: nothing for "1", a pure number."""
    return "" if unit == "1" else unit


def label_quantity(name: str, unit: str) -> str:
    """Return the label of an axis: name and unit, such as "tau_1 (h)"; the name alone for a pure number.

    Parameters
    ----------
    name, unit : str
    """
    unit = format_unit(unit)
    return f"{name} ({unit})" if unit else name


def wrap_quantity(name: str, unit: str = "") -> str:
    """Return the label of an upright axis, as `label_quantity`, in lines no longer than a panel is high.

    Parameters
    ----------
    name, unit : str
    """
    return textwrap.fill(label_quantity(name, unit), 20)


def get_unit(comparison: Comparison, channel: int, trajectory: Trajectory) -> str:
    """Return the unit of a channel as it is shown: its own, or that of the state of the same name.

    "" if it is unknown, and for a pure number.

    Parameters
    ----------
    comparison : Comparison
    channel : int
        Which channel, from 0.
    trajectory : Trajectory
        Of the same experiment.
    """
    if comparison.units and comparison.units[channel]:
        return format_unit(comparison.units[channel])
    units = dict(zip(trajectory.state_names, trajectory.state_units, strict=True))
    return format_unit(units.get(comparison.names[channel], ""))
