"""Checks of names and labels: strings, choices, sequences of names, and columns by name."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from typing import TypeVar, overload

from switchfit.problem.validation.arrays import TEXT_TYPES
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.problem.validation.tables import list_columns

Choice = TypeVar("Choice", bound=str)
Entry = TypeVar("Entry")


def as_choice(value: object, what: str, choices: Sequence[Choice]) -> Choice:
    """Return one of the strings `choices`."""
    if isinstance(value, str) and value in choices:
        return choices[choices.index(value)]
    # Three choices stand in the sentence with their quotes; a longer list is easier to read without.
    *others, last = map(repr, choices)
    wanted = f"{', '.join(others)} or {last}" if len(choices) <= 3 else f"one of {', '.join(choices)}"
    error = ValueError if isinstance(value, str) else TypeError
    raise error(f"{what} must be {wanted}; got {shorten(value)}.")


def as_name(value: object, what: str, form: str = "a string", *, empty: bool = False) -> str:
    """Return a string, which must not be empty unless that is allowed."""
    if not isinstance(value, str):
        raise TypeError(f"{what} must be {form}; got {shorten(value)}.")
    if not (value.strip() or empty):
        raise ValueError(f"{what} must not be empty; got {shorten(value)}.")
    return str(value)


def as_names(value: object, what: str, form: str) -> tuple[str, ...]:
    """Return a sequence of strings that are not empty and differ from each other."""
    names = tuple(as_name(name, what, form) for name in as_sequence(value, what, form))
    if len(set(names)) < len(names):
        twice = next(name for k, name in enumerate(names) if name in names[:k])
        raise ValueError(f"{what} must differ from each other; got {shorten(twice)} twice.")
    return names


def require_known(names: Iterable[object], what: str, known: Collection[str]) -> None:
    """Raise ValueError if one of several names is not that of a mode."""
    for name in names:
        if name not in known:
            raise ValueError(f"{what} names the unknown mode {shorten(name)}; the modes are {join_names(known)}.")


def as_labels(value: object, what: str, each: str, count: int | None = None) -> tuple[str, ...] | None:
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


def as_named_columns(value: object, what: str, form: str) -> dict[str, object] | None:
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
        names = as_names([name for name, _ in table], f"columns of {what}", "strings")
        return dict(zip(names, (column for _, column in table), strict=True))
    if table is not None or not isinstance(value, Mapping):
        return None
    if not value:
        raise ValueError(f"{what} must have a name for each entry of u, with its {form}; got an empty dict.")
    return {as_name(name, f"names in {what}", "strings"): entry for name, entry in value.items()}


@overload
def as_sequence(value: Iterable[Entry], what: str, form: str) -> tuple[Entry, ...]: ...


@overload
def as_sequence(value: object, what: str, form: str) -> tuple[object, ...]: ...


def as_sequence(value: object, what: str, form: str) -> tuple[object, ...]:
    """Return the entries of a list, a tuple, an array or another sequence.

    Raises
    ------
    TypeError
        For text, and for collections without order or that can be read only once: sets, dicts, generators.
    """
    if isinstance(value, (*TEXT_TYPES, AbstractSet, Mapping, Iterator)):
        raise TypeError(f"{what} must be {form}; got {shorten(value)}: give a list or a tuple.")
    try:
        return tuple(value)  # type: ignore[arg-type]  # what cannot be iterated raises
    except Exception:  # TypeError; arrays without dimensions and others raise their own
        raise TypeError(f"{what} must be {form}; got {shorten(value)}.") from None
