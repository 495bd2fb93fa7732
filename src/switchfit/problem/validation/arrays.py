"""Checks of numbers and arrays, which are returned as float, int or float64 arrays.

- Numbers are integers and floating-point numbers of Python, NumPy, JAX, pandas, polars and xarray. Truth values,
  complex numbers, text, dates and `None` are not numbers here, although NumPy would convert most of them.
- Numbers of less than double precision are refused if their values as doubles show that they have lost digits.
- Masked arrays with masked entries are refused: a missing sample is NaN.
"""

from __future__ import annotations

import datetime
import math
import numbers
import operator
from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from decimal import Decimal
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.problem.validation.messages import shorten
from switchfit.problem.validation.precision import is_low_precision, refuse_single_precision
from switchfit.problem.validation.tables import is_of_library, list_columns

Exact: TypeAlias = "ArrayLike | list[Exact]"
"""What `numpy.array` converts to float64 without changing a number."""

ARRAY = "a number or an array of numbers"
LARGEST_COUNT = 10**9
LARGEST_SEED = 2**64 - 1

MOST_DIMENSIONS = 8
"""Largest depth of nested lists: lists that contain themselves have no end."""

BEYOND_DOUBLES = "beyond the largest double, 1.8e308"
_INTEGERS = (np.int8, np.int16, np.int32, np.int64, np.uint8, np.uint16, np.uint32, np.uint64)

_EXACT: frozenset[type] = frozenset({int, float, np.float64, *_INTEGERS})
"""Types that `numpy.array(..., dtype=float64)` reads without change."""

NO_DATES = ": dates and time differences are not supported; give (dates - dates[0]) / np.timedelta64(1, 's')"
TEXT_TYPES = (str, bytes, bytearray)
_DATES = (datetime.date, datetime.time, datetime.timedelta)


class _WrongEntryError(Exception):
    """An entry of an argument is not a number: the entry, the type of the error to raise, and why."""


def as_array(value: object, what: str, *, form: str = ARRAY, finite: bool = False) -> FloatArray:
    """Return `value` as a new float64 array of any shape.

    Parameters
    ----------
    value : number, array, or nested list or tuple of numbers
    what : str
        Name of the argument, for messages.
    form : str, optional
        Its required form, for messages.
    finite : bool, optional
        Whether NaN and infinities are refused.

    Raises
    ------
    TypeError
        If something in it is not a number.
    ValueError
        For text, nested lists of different lengths, numbers beyond the range of doubles, masked entries, or
        single-precision numbers that have lost digits.
    """
    try:
        # The fast way: most arguments are floats and float64 arrays, and are read a thousand times in a search.
        is_double = type(value) is float or (type(value) is np.ndarray and value.dtype == np.float64)
        exact = value if is_double else _read_exactly(value, what)
    except _WrongEntryError as wrong:
        entry, error, why = wrong.args
        inside = "" if entry is value else f", in which {shorten(entry)} is not a number"
        raise error(f"{what} must be {form}; got {shorten(value)}{inside}{why}.") from None
    try:
        with np.errstate(all="ignore"):
            array = np.array(exact, dtype=np.float64)
    except (OverflowError, ValueError) as error:
        why = (
            f"with a number {BEYOND_DOUBLES}"
            if isinstance(error, OverflowError)
            else "whose rows differ in length or shape"
        )
        raise ValueError(f"{what} must be {form}; got {shorten(value)}, {why}.") from None
    # After the conversion: an integer beyond 1.8e308 becomes infinite only there.
    if finite and not np.isfinite(array).all():
        where = np.argwhere(~np.isfinite(array))[0].tolist()
        raise ValueError(f"{what} must be finite; got {array[tuple(where)]}{f' at index {where}' if where else ''}.")
    return array


def as_number(value: object, what: str) -> float:
    """Return `value` as a float; NaN and infinities are allowed."""
    if type(value) is float:
        return value
    number = as_array(value, what, form="a number")
    if number.size != 1:
        raise ValueError(f"{what} must be a single number; got {shorten(value)}.")
    return float(number.item())


def as_finite(value: object, what: str) -> float:
    """Return `value` as a finite float."""
    number = as_number(value, what)
    if not math.isfinite(number):
        raise ValueError(f"{what} must be finite; got {number}.")
    return number


def as_positive(value: object, what: str) -> float:
    """Return `value` as a positive, finite float."""
    number = as_number(value, what)
    if not number > 0:
        raise ValueError(f"{what} must be positive; got {number}.")
    return as_finite(number, what)


def as_not_negative(value: object, what: str) -> float:
    """Return `value` as a finite float that is 0 or more."""
    number = as_finite(value, what)
    if number < 0:
        raise ValueError(f"{what} must be 0 or more; got {number}.")
    return number


def require_deviation(sd: FloatArray, what: str) -> None:
    """Raise ValueError unless standard deviations are positive and finite, and so are their inverse squares."""
    with np.errstate(all="ignore"):
        if not np.all((sd > 0) & np.isfinite(sd) & np.isfinite(sd**-2.0)):
            raise ValueError(f"{what} must be positive and finite, and so must its inverse square; got {sd.min()}.")


def as_level(value: object) -> float:
    """Return a confidence level as a float between 0 and 1."""
    number = as_number(value, "level")
    if not 0 < number < 1:
        raise ValueError(f"level must lie between 0 and 1; got {number}.")
    return number


def as_count(value: object, what: str, *, at_least: int = 0, at_most: int = LARGEST_COUNT) -> int:
    """Return an integer of Python, NumPy or JAX as an int in the given range; floats are not accepted."""
    try:
        # A bool is an int in Python: `seed=True` is a slip.
        count = None if isinstance(value, (bool, np.bool_)) else operator.index(value)  # type: ignore[arg-type]
    except Exception:  # TypeError; JAX's tracers raise their own
        count = None
    if count is None or getattr(value, "dtype", None) == np.bool_:
        raise TypeError(f"{what} must be a whole number (an int); got {shorten(value)}.")
    if count < at_least:
        wanted = "must not be negative" if at_least == 0 else f"must be {at_least} or more"
        raise ValueError(f"{what} {wanted}; got {shorten(count)}.")
    if count > at_most:
        raise ValueError(f"{what} must be at most {at_most}; got {shorten(count)}.")
    return count


def as_seed(value: object) -> int:
    """Return the seed of a random number generator."""
    return as_count(value, "seed", at_most=LARGEST_SEED)


def as_index(value: object, what: str, size: int) -> int:
    """Return an index from 0 to `size` - 1."""
    try:
        return as_count(value, what, at_most=size - 1)
    except ValueError:
        raise ValueError(f"{what} must lie in 0..{size - 1}; got {shorten(value)}.") from None


def _read_exactly(value: Any, what: str, depth: int = 0) -> Exact:
    """Return a number, an array or nested lists that `numpy.array` converts to float64 without changing a number."""
    if type(value) in _EXACT:
        return value
    if depth > MOST_DIMENSIONS:
        raise _WrongEntryError(value, ValueError, f", which is nested more than {MOST_DIMENSIONS} deep")
    table = list_columns(value)
    if table is not None:  # its columns may differ in type
        columns = [_read_exactly(column, what, depth + 1) for _, column in table]
        return np.stack([np.asarray(column) for column in columns], axis=1) if columns else np.zeros((len(value), 0))
    # Arrays of NumPy, JAX, pandas, polars, xarray: whatever NumPy can read without a loss.
    if hasattr(value, "__array__") and not isinstance(value, type):
        return _read_array_exactly(value, what, depth)
    if isinstance(value, Sequence) and not isinstance(value, (*TEXT_TYPES, memoryview)):
        is_exact = set(map(type, value)) <= _EXACT
        return list(value) if is_exact else [_read_exactly(entry, what, depth + 1) for entry in value]
    if isinstance(value, (numbers.Real, Decimal)) and not isinstance(value, bool):
        try:
            return float(value)
        except Exception as error:  # also a faulty __float__
            is_large = isinstance(error, OverflowError)
            raise _WrongEntryError(
                value, ValueError if is_large else TypeError, f", {BEYOND_DOUBLES}" * is_large
            ) from None
    if isinstance(value, _DATES):
        raise _WrongEntryError(value, TypeError, NO_DATES)
    why = ": give a list or an array" if isinstance(value, (Iterator, AbstractSet)) else ""
    raise _WrongEntryError(value, ValueError if isinstance(value, TEXT_TYPES) else TypeError, why)


def _read_array_exactly(value: Any, what: str, depth: int) -> Exact:
    """Return an array, or another object with a dtype, as an array of integers or doubles."""
    # NumPy would take the hidden number under the mask for a sample.
    if np.any(np.ma.getmask(value)):
        raise _WrongEntryError(
            value, ValueError, ", a masked array: fill in what is masked, with NaN where it is missing"
        )
    try:
        is_pandas = is_of_library(value, "pandas")
        array = value.to_numpy(na_value=np.nan) if is_pandas else np.asarray(value)
    except Exception as error:
        raise _WrongEntryError(value, TypeError, f", which NumPy cannot read ({type(error).__name__})") from None
    if array.dtype.kind in "Mm":
        raise _WrongEntryError(value, TypeError, NO_DATES)
    # Objects: each entry by itself, as in a list. pandas makes such columns where a cell is missing.
    if array.dtype.kind == "O":
        return _read_exactly(array.tolist(), what, depth + 1)
    if is_low_precision(array.dtype):
        refuse_single_precision(array, what)
    elif array.dtype.kind not in "iuf":
        raise _WrongEntryError(value, ValueError if array.dtype.kind in "SUT" else TypeError, f" ({array.dtype})")
    return array.astype(np.float64)
