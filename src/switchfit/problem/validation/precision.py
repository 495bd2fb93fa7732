"""Refuse numbers of less than double precision if their values show that they have lost digits."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike


def is_low_precision(dtype: DTypeLike) -> bool:
    """Return whether this is the dtype of floating-point numbers of less than double precision."""
    dtype = np.dtype(dtype)
    return dtype.itemsize < 8 and dtype.name.startswith(("float", "bfloat"))


def refuse_single_precision(value: object, what: str) -> None:
    """Raise if an array or a scalar of less than double precision has numbers that have lost digits.

    A number passes if it equals the double with its shortest decimal text, as 0.5 and 3.0 do. The text of
    ``float32(0.1)`` is 0.1, but the number is 0.10000000149011612: a fit would solve another problem, with an error of
    1e-8 that no check inside the fit can detect.

    Parameters
    ----------
    value : array or scalar of NumPy or JAX
        Any other type and any other dtype pass.
    what : str
        Name of the argument, or of the constant.

    Raises
    ------
    ValueError
        With the first number that has lost digits, and what to write instead.
    """
    dtype = getattr(value, "dtype", None)
    if not isinstance(dtype, np.dtype) or not is_low_precision(dtype):
        return
    given = np.asarray(value).ravel()
    wide = given.astype(np.float64)
    # The shortest decimal text that reads back as this float32 is what the user wrote, or would have.
    meant = np.array([float(str(number)) for number in given])
    changed = np.flatnonzero(np.isfinite(wide) & (meant != wide))
    if not changed.size:
        return
    first = changed[0]
    raise ValueError(
        f"{what} must be in double precision: {float(meant[first])!r} became {float(wide[first])!r} "
        f"({given.dtype.name}). Write a list or a NumPy array: by default JAX makes arrays of 32 bits. If the numbers "
        "really have that precision, as those of a log may, write np.asarray(values, dtype=np.float64)."
    )
