"""Checks of users' arguments: each function returns the value in the form that the code uses, or raises.

Every public constructor, function and method passes its arguments through here, so that a mistake is reported in one
sentence where it was made, and not by an error of NumPy or JAX somewhere inside. A message names the argument, the
required form and the value that was given (shortened, `shorten`).

- `TypeError` for a wrong type, `ValueError` for a wrong value. Text in place of a number is a wrong value, as it is for
  ``float("x")``.
- Numbers are integers and floating-point numbers of Python, NumPy, JAX, pandas, polars and xarray. Truth values,
  complex numbers, text, dates and `None` are not numbers here, although NumPy would convert most of them.
- Numbers of less than double precision are refused if their values as doubles show that they have lost digits
  (`refuse_single_precision`).
- Masked arrays with masked entries are refused: a missing sample is NaN.

Problem files are validated with pydantic, Python calls are not. pydantic does not handle arrays, precision, masks or
dates, so that every field would need a validator of its own, like the functions below; its errors are tables about a
model class instead of a sentence about an argument; and it takes longer to import than everything else that `import
switchfit` loads.

Tables of other libraries (pandas, polars, xarray, our own logs): their columns, names and units.

None of these libraries is imported: an object is known by the package of its class.
"""

from __future__ import annotations

import datetime
import inspect
import math
import numbers
import operator
import os
import reprlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from decimal import Decimal
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from switchfit.runtime.presentation import join_first

LIBRARIES = frozenset({"pandas", "polars", "xarray", "switchfit"})


def is_of_library(value: Any, *names: str) -> bool:
    """Return whether the class of an object, or one that it is derived from, is of one of the packages."""
    return any(kind.__module__.partition(".")[0] in names for kind in type(value).__mro__)


def list_columns(value: Any) -> list[tuple[Any, Any]] | None:
    """Return (name, column) of each column of a table; None for anything else.

    Tables are DataFrames of pandas and polars, Datasets of xarray and logs.
    """
    if not is_of_library(value, *LIBRARIES):
        return None
    if hasattr(value, "data_vars"):
        return list(value.data_vars.items())
    if not hasattr(value, "columns"):
        return None
    if hasattr(value, "iloc"):  # in pandas, names may be anything, and stand there twice
        return [(name, value.iloc[:, k]) for k, name in enumerate(value.columns)]
    return [(name, value[name]) for name in value.columns]


def find_labels(value: Any) -> tuple[tuple[str, ...] | None, tuple[str, ...] | None]:
    """Return the names and the units of the columns of a table, or of the one column that it is.

    Names are None unless all are strings and differ; an array of xarray with labels along its second dimension has
    these. Units are in ``attrs["units"]`` of the table or the column, a string or a mapping from names to units; they
    are None where no unit is given.
    """
    channels = list_columns(value)
    if channels is None and is_of_library(value, *LIBRARIES):
        channels = [(getattr(value, "name", None), value)]
        if getattr(value, "ndim", 1) == 2:
            channels = [(label.item(), value) for label in value.coords.get(value.dims[1], ())]
    channels = channels or []
    names = [name for name, _ in channels]
    proper = all(isinstance(name, str) and name.strip() for name in names) and len(set(names)) == len(names)
    units = tuple(_find_unit(column, name) or _find_unit(value, name) for name, column in channels)
    return tuple(map(str, names)) if names and proper else None, units if any(units) else None


def _find_unit(value: Any, name: Any) -> str:
    attributes = getattr(value, "attrs", None)
    units = attributes.get("units", "") if isinstance(attributes, Mapping) else ""
    unit = units.get(name, "") if isinstance(units, Mapping) else units
    return unit if isinstance(unit, str) else ""


FloatArray = NDArray[np.float64]
T = TypeVar("T")

ARRAY = "a number or an array of numbers"
LARGEST_COUNT = 10**9
LARGEST_SEED = 2**64 - 1
MOST_DIMENSIONS = 8
"""Largest depth of nested lists: lists that contain themselves have no end."""
BEYOND = "beyond the largest double, 1.8e308"
LONGEST = 120
"""Largest number of characters of a value that a message shows."""
MOST_LISTED = 10
"""Largest number of names that a message lists."""

_INTEGERS = (np.int8, np.int16, np.int32, np.int64, np.uint8, np.uint16, np.uint32, np.uint64)
_EXACT: frozenset[type] = frozenset({int, float, np.float64, *_INTEGERS})
"""Types that `numpy.array(..., dtype=float64)` reads without change."""
NO_DATES = ": dates and time differences are not supported; give (dates - dates[0]) / np.timedelta64(1, 's')"
_TEXT = (str, bytes, bytearray)
_DATES = (datetime.date, datetime.time, datetime.timedelta)


# --- what messages show -----------------------------------------------------------------------------------------------


_SHORT = reprlib.Repr()
"""Representations of bounded length, computed in bounded time."""
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxset = _SHORT.maxfrozenset = _SHORT.maxdeque = _SHORT.maxdict = 6
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 4, 60, 60


def shorten(value: Any) -> str:
    """Return any value as text for a message: at most `LONGEST` characters."""
    try:
        is_small = hasattr(value, "tolist") and np.size(value) <= 8
        text = " ".join(_SHORT.repr(value.tolist() if is_small else value).split())
    except Exception:  # a faulty __repr__
        text = f"an object of type {type(value).__name__}"
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


def join_names(names: Iterable[Any]) -> str:
    """Return names with commas between them, the first ten if there are more; 'none' for no names."""
    return join_first((f"{name!s:.40}" for name in names), MOST_LISTED) or "none"


# --- numbers ----------------------------------------------------------------------------------------------------------


class _WrongEntryError(Exception):
    """An entry of an argument is not a number: the entry, the type of the error to raise, and why."""


def as_array(value: Any, what: str, *, form: str = ARRAY, finite: bool = False) -> FloatArray:
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
        why = f"with a number {BEYOND}" if isinstance(error, OverflowError) else "whose rows differ in length or shape"
        raise ValueError(f"{what} must be {form}; got {shorten(value)}, {why}.") from None
    if finite and not np.isfinite(array).all():
        where = np.argwhere(~np.isfinite(array))[0].tolist()
        raise ValueError(f"{what} must be finite; got {array[tuple(where)]}{f' at index {where}' if where else ''}.")
    return array


def as_number(value: Any, what: str) -> float:
    """Return `value` as a float; NaN and infinities are allowed."""
    if type(value) is float:
        return value
    number = as_array(value, what, form="a number")
    if number.size != 1:
        raise ValueError(f"{what} must be a single number; got {shorten(value)}.")
    return float(number.item())


def as_finite(value: Any, what: str) -> float:
    """Return `value` as a finite float."""
    number = as_number(value, what)
    if not math.isfinite(number):
        raise ValueError(f"{what} must be finite; got {number}.")
    return number


def as_positive(value: Any, what: str) -> float:
    """Return `value` as a positive, finite float."""
    number = as_number(value, what)
    if not number > 0:
        raise ValueError(f"{what} must be positive; got {number}.")
    return as_finite(number, what)


def as_not_negative(value: Any, what: str) -> float:
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


def as_level(value: Any) -> float:
    """Return a confidence level as a float between 0 and 1."""
    number = as_number(value, "level")
    if not 0 < number < 1:
        raise ValueError(f"level must lie between 0 and 1; got {number}.")
    return number


def as_count(value: Any, what: str, *, at_least: int = 0, at_most: int = LARGEST_COUNT) -> int:
    """Return an integer of Python, NumPy or JAX as an int in the given range; floats are not accepted."""
    try:
        count = None if isinstance(value, (bool, np.bool_)) else operator.index(value)
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


def as_seed(value: Any) -> int:
    """Return the seed of a random number generator."""
    return as_count(value, "seed", at_most=LARGEST_SEED)


def as_index(value: Any, what: str, size: int) -> int:
    """Return an index from 0 to `size` - 1."""
    try:
        return as_count(value, what, at_most=size - 1)
    except ValueError:
        raise ValueError(f"{what} must lie in 0..{size - 1}; got {shorten(value)}.") from None


def _read_exactly(value: Any, what: str, depth: int = 0) -> Any:
    """Return a number, an array or nested lists that `numpy.array` converts to float64 without changing a number."""
    if type(value) in _EXACT:
        return value
    if depth > MOST_DIMENSIONS:
        raise _WrongEntryError(value, ValueError, f", which is nested more than {MOST_DIMENSIONS} deep")
    table = list_columns(value)
    if table is not None:  # its columns may differ in type
        columns = [_read_exactly(column, what, depth + 1) for _, column in table]
        return np.stack(columns, axis=1) if columns else np.zeros((len(value), 0))
    if hasattr(value, "__array__") and not isinstance(value, type):
        return _read_array_exactly(value, what, depth)
    if isinstance(value, Sequence) and not isinstance(value, (*_TEXT, memoryview)):
        is_exact = set(map(type, value)) <= _EXACT
        return list(value) if is_exact else [_read_exactly(entry, what, depth + 1) for entry in value]
    if isinstance(value, (numbers.Real, Decimal)) and not isinstance(value, bool):
        try:
            return float(value)
        except Exception as error:  # also a faulty __float__
            is_large = isinstance(error, OverflowError)
            raise _WrongEntryError(value, ValueError if is_large else TypeError, f", {BEYOND}" * is_large) from None
    if isinstance(value, _DATES):
        raise _WrongEntryError(value, TypeError, NO_DATES)
    why = ": give a list or an array" if isinstance(value, (Iterator, AbstractSet)) else ""
    raise _WrongEntryError(value, ValueError if isinstance(value, _TEXT) else TypeError, why)


def _read_array_exactly(value: Any, what: str, depth: int) -> Any:
    """Return an array, or another object with a dtype, as an array of integers or doubles."""
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
    if array.dtype.kind == "O":
        return _read_exactly(array.tolist(), what, depth + 1)
    if is_low_precision(array.dtype):
        refuse_single_precision(array, what)
    elif array.dtype.kind not in "iuf":
        raise _WrongEntryError(value, ValueError if array.dtype.kind in "SUT" else TypeError, f" ({array.dtype})")
    return array.astype(np.float64)


# --- single precision -------------------------------------------------------------------------------------------------


def is_low_precision(dtype: Any) -> bool:
    """Return whether this is the dtype of floating-point numbers of less than double precision."""
    dtype = np.dtype(dtype)
    return dtype.itemsize < 8 and dtype.name.startswith(("float", "bfloat"))


def refuse_single_precision(value: Any, what: str) -> None:
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


# --- everything else --------------------------------------------------------------------------------------------------


def set_fields(record: object, **values: object) -> None:
    """Set fields of a frozen dataclass while it is being built."""
    for name, value in values.items():
        object.__setattr__(record, name, value)


def as_flag(value: Any, what: str) -> bool:
    """Return a truth value of Python or NumPy as a bool; numbers are not accepted."""
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"{what} must be True or False; got {shorten(value)}.")
    return bool(value)


def as_choice(value: Any, what: str, choices: Sequence[str]) -> Any:
    """Return one of the strings `choices`."""
    if isinstance(value, str) and value in choices:
        return choices[choices.index(value)]
    *others, last = map(repr, choices)
    wanted = f"{', '.join(others)} or {last}" if len(choices) <= 3 else f"one of {', '.join(choices)}"
    error = ValueError if isinstance(value, str) else TypeError
    raise error(f"{what} must be {wanted}; got {shorten(value)}.")


def as_name(value: Any, what: str, form: str = "a string", *, empty: bool = False) -> str:
    """Return a string, which must not be empty unless that is allowed."""
    if not isinstance(value, str):
        raise TypeError(f"{what} must be {form}; got {shorten(value)}.")
    if not (value.strip() or empty):
        raise ValueError(f"{what} must not be empty; got {shorten(value)}.")
    return str(value)


def as_names(value: Any, what: str, form: str) -> tuple[str, ...]:
    """Return a sequence of strings that are not empty and differ from each other."""
    names = tuple(as_name(name, what, form) for name in as_sequence(value, what, form))
    if len(set(names)) < len(names):
        twice = next(name for k, name in enumerate(names) if name in names[:k])
        raise ValueError(f"{what} must differ from each other; got {shorten(twice)} twice.")
    return names


def require_known(names: Iterable[Any], what: str, known: Iterable[str]) -> None:
    """Raise ValueError if one of several names is not that of a mode."""
    for name in names:
        if name not in known:
            raise ValueError(f"{what} names the unknown mode {shorten(name)}; the modes are {join_names(known)}.")


def as_labels(value: Any, what: str, each: str, count: int | None = None) -> tuple[str, ...] | None:
    """Return the names or the units of something, a string for each; None for None.

    Parameters
    ----------
    value : sequence of str, or a string for one
    what : str
        Strings that are called "names" must not be empty, and must differ from each other.
    each : str
        Such as "channel".
    count : int, optional
        How many there have to be.
    """
    if value is None:
        return None
    form = f"a sequence of strings, one for each {each}"
    labels = (value,) if isinstance(value, str) and count is not None else as_sequence(value, what, form)
    if what.endswith("names"):
        checked = as_names(labels, what, form)
    else:
        checked = tuple(as_name(unit, f"each of {what}", empty=True) for unit in labels)
    if count is not None and len(checked) != count:
        raise ValueError(f"{what} must have one entry for each of the {count} {each}s; got {shorten(checked)}.")
    return checked


def as_named_columns(value: Any, what: str, form: str) -> dict[str, Any] | None:
    """Return the entries of a mapping, or of a table whose columns are all named by strings; else None.

    Raises
    ------
    TypeError
        If a key of a mapping is not a string.
    ValueError
        If a mapping is empty, a key is empty, or two columns of a table share a name.
    """
    table = list_columns(value)
    if table and all(isinstance(name, str) for name, _ in table):
        as_names([name for name, _ in table], f"columns of {what}", "strings")
        return dict(table)
    if table is not None or not isinstance(value, Mapping):
        return None
    if not value:
        raise ValueError(f"{what} must have a name for each entry of u, with its {form}; got an empty dict.")
    return {as_name(name, f"names in {what}", "strings"): entry for name, entry in value.items()}


def as_sequence(value: Any, what: str, form: str) -> tuple[Any, ...]:
    """Return the entries of a list, a tuple, an array or another sequence.

    Raises
    ------
    TypeError
        For text, and for collections without order or that can be read only once: sets, dicts, generators.
    """
    if isinstance(value, (*_TEXT, AbstractSet, Mapping, Iterator)):
        raise TypeError(f"{what} must be {form}; got {shorten(value)}: give a list or a tuple.")
    try:
        return tuple(value)
    except Exception:  # TypeError; arrays without dimensions and others raise their own
        raise TypeError(f"{what} must be {form}; got {shorten(value)}.") from None


def as_instance(value: Any, what: str, kind: type[T], form: str) -> T:
    """Return `value` if it is an instance of `kind`; messages use `form` as its name."""
    if not isinstance(value, kind):
        raise TypeError(f"{what} must be {form}; got {type(value).__name__}.")
    return value


def as_instances(value: Any, what: str, kind: type[T], form: str) -> tuple[T, ...]:
    """Return an instance of `kind`, or a sequence of them, as a tuple; messages use `form` as the name of one."""
    form = f"{form} or a list of them"
    items = (value,) if isinstance(value, kind) else as_sequence(value, what, form)
    return tuple(as_instance(item, what, kind, form) for item in items)


def as_callable(value: Any, what: str, form: str, *, arguments: int | None = None) -> Callable[..., Any]:
    """Return a function, which must not be a class; messages use `form` as its name.

    Parameters
    ----------
    value : callable
    what : str
    form : str
        Such as ``"a function h(t, x, p)"``.
    arguments : int, optional
        Number of arguments with which it is called; checked if its signature is known.
    """
    if not callable(value) or isinstance(value, type):
        raise TypeError(f"{what} must be {form}; got {shorten(value)}.")
    misfit = None if arguments is None else find_misfit(value, range(arguments))
    if misfit is not None:
        raise TypeError(
            f"{what} must be {form}; got one that cannot be called with {arguments} argument(s): "
            f"it takes {str(misfit)[:LONGEST]}."
        )
    return value


def find_misfit(function: Callable[..., Any], arguments: Iterable[Any]) -> inspect.Signature | None:
    """Return the signature of a function that cannot be called with some arguments; None if it can."""
    try:
        signature = inspect.signature(function)
    except Exception:  # functions written in C have none
        return None
    try:
        signature.bind(*arguments)
    except TypeError:
        return signature
    return None


def as_path(value: Any, what: str) -> Path:
    """Return a path that is not empty."""
    text = os.fspath(value) if isinstance(value, (str, os.PathLike)) else None
    if not isinstance(text, str):
        raise TypeError(f"{what} must be a path (a string or a pathlib.Path); got {shorten(value)}.")
    if not text.strip() or "\0" in text:
        raise ValueError(f"{what} must be a path; got {shorten(value)}.")
    return Path(text)
