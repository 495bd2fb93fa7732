"""Dataclasses as JSON that can be read without switchfit, and loaded without losing a bit.

- numbers are written with as many digits as it takes to read the same float64; JSON has no NaN and no infinities, so
  they are the strings ``"NaN"``, ``"Infinity"`` and ``"-Infinity"``;
- an array of float64 is a list, or a list of rows; any other, and an empty one, is
  ``{"dtype": ..., "shape": ..., "values": [...]}``;
- a status is its name; other dataclasses are objects with their fields.

`from_json` checks what is read against the types of the dataclass's fields.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, Union, get_args, get_origin, get_type_hints

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

NONFINITE_NUMBERS = ("NaN", "Infinity", "-Infinity")
"""Strings that stand for numbers."""

Json: TypeAlias = Any
"""What `json.loads` returns: its type is what `from_json` finds out."""

Annotation: TypeAlias = Any
"""The type of a field: a class, a union, ``tuple[...]``, ``Literal[...]``; typing has no type for all of them."""


# --- to JSON ----------------------------------------------------------------------------------------------------------


def to_json(record: object, kind: type) -> Json:
    """Return a dataclass by the fields of `kind` in terms of dict, list, str, int, finite float, bool and None.

    Parameters
    ----------
    record : object
    kind : type
        Of the record, or a dataclass with some of its fields.
    """
    from pydantic_core import to_json as encode  # imported here, since that takes longer than a small fit

    values = {f.name: getattr(record, f.name) for f in fields(kind)}
    named = {name: value.name if isinstance(value, Enum) else value for name, value in values.items()}
    return json.loads(encode(named, inf_nan_mode="strings", fallback=_encode_array))


def _encode_array(value: object) -> Json:
    """Return an array as a list, or with its dtype and shape; TypeError for anything else."""
    import numpy as np

    if not isinstance(value, np.ndarray):
        raise TypeError(f"a {type(value).__name__} cannot be saved.")
    if value.dtype == np.float64 and value.size > 0:
        return value.tolist()
    return {"dtype": value.dtype.str, "shape": list(value.shape), "values": value.ravel().tolist()}


# --- from JSON --------------------------------------------------------------------------------------------------------


def from_json(kind: Annotation, content: Json, where: str) -> Any:
    """Return a dataclass from JSON.

    Parameters
    ----------
    kind : type
    content : object
    where : str
        Name of the content, for the message.

    Raises
    ------
    ValueError
        If an entry is missing, unknown or of another type.
    """
    try:
        return _read(kind, content)
    except Exception as error:  # whatever is wrong with it
        raise ValueError(f"{where} is not what was written") from error


def _read(kind: Annotation, content: Json) -> Any:
    """Return what a type stands for: a dataclass, or one of the types of its fields; an error of any kind if wrong."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (UnionType, Union):
        return _read_either(inner, content)
    if isinstance(kind, type) and is_dataclass(kind):
        hints = _get_hints(kind)
        # Both directions: an entry that is unknown is from another version, whose meaning is not known here.
        if hints.keys() != content.keys():
            raise KeyError
        return kind(**{name: _read(hint, content[name]) for name, hint in hints.items()})
    if origin is tuple and isinstance(content, list):
        # tuple[X, ...] has one type for all entries, tuple[X, Y] one for each.
        kinds = inner[:1] * len(content) if inner[-1] is Ellipsis else inner
        return tuple(_read(*pair) for pair in zip(kinds, content, strict=True))
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return {name: _read(inner[1], entry) for name, entry in content.items()}
    if (dtype := find_dtype(kind)) is not None:
        return _read_array(dtype, content)
    if origin is Literal:
        return inner[inner.index(content)]
    if issubclass(kind, Enum):
        return kind[content]
    # JSON has one kind of number: 1.0 may have been written as 1 by another program.
    if kind is float and (type(content) is int or content in NONFINITE_NUMBERS):
        return float(content)
    if type(content) is not kind:
        raise TypeError
    return content


def _read_either(kinds: tuple[Annotation, ...], content: Json) -> Any:
    """Return the content as the first of several types that it can be."""
    if content is None and NoneType in kinds:
        return None
    for kind in kinds:
        # In the order of the union: the types of one union differ in what they read, so that the first that fits is
        # meant.
        with suppress(Exception):
            return _read(kind, content)
    raise TypeError


@cache
def _get_hints(kind: Annotation) -> dict[str, Annotation]:
    """Return the types of the fields of a dataclass by their names."""
    hints = get_type_hints(kind)
    return {f.name: hints[f.name] for f in fields(kind)}


def find_dtype(kind: Annotation) -> np.dtype[Any] | None:
    """Return the dtype of an annotation that stands for an array; None for any other.

    Parameters
    ----------
    kind : type
        ``NDArray[...]``: a name for ``np.ndarray[...]``, or from NumPy 2.5 on an alias with an origin of its own.
    """
    import numpy as np
    from numpy.typing import NDArray

    if get_origin(kind) not in (np.ndarray, NDArray):
        return None
    last = get_args(kind)[-1]
    return np.dtype((get_args(last) or (last,))[0])


def _read_array(declared: np.dtype[Any], value: Json) -> NDArray[Any]:
    """Return an array of the declared type from a list of numbers, or from its dtype, shape and values."""
    import numpy as np

    if isinstance(value, dict):
        array = np.array(value["values"], dtype=value["dtype"]).reshape(value["shape"])
    else:
        array = np.array(value, dtype=np.float64)
    # The kind alone, not the size: int64 and int32 are written on different systems.
    if array.dtype.kind != declared.kind:
        raise TypeError
    return array
