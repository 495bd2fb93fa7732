"""Read a problem file into checked tables, and say in a sentence what is wrong with it."""

from __future__ import annotations

import difflib
import inspect
import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

import pydantic

from switchfit.io.logs.files import ENDINGS
from switchfit.io.problem_file.tables import Contents, Table
from switchfit.runtime.errors import InputError
from switchfit.runtime.files import explain_read_errors

T = TypeVar("T", bound=Table)


def read_text(path: Path) -> str:
    """Return the text of a problem file; raise InputError if it cannot be read.

    Parameters
    ----------
    path : Path
    """
    with explain_read_errors(path, "problem file", "the problem file"):
        data = path.read_bytes()
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not valid TOML: {error}.{_suggest_init(path)}") from error


def _suggest_init(path: Path) -> str:
    """Return what to do with a log that was given in place of a problem file; an empty string for another file."""
    is_log = path.name.lower().endswith(ENDINGS)
    return f" If it is a log, begin with: switchfit init NAME --from {path}" if is_log else ""


def _parse(path: Path, text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise InputError(f"{path} is not valid TOML: brackets are nested too deep.") from error
    except ValueError as error:  # invalid TOML, or a number with thousands of digits
        raise InputError(f"{path} is not valid TOML: {error}.{_suggest_init(path)}") from error


def parse_contents(path: Path, text: str) -> Contents:
    """Return the checked tables of a problem file; raise InputError with the key that is wrong.

    Parameters
    ----------
    path : Path
        For messages.
    text : str
    """
    given = _parse(path, text)
    contents = check_table(Contents, given, str(path))
    if contents.problem is not None:
        others = [key for key in ("model", "parameters", "experiments") if key in given]
        if others:
            raise InputError(f"{path}: 'problem' replaces everything but options; leave out {' and '.join(others)}.")
    elif contents.model is None:
        from switchfit.models import BUILT_IN  # here, since it imports JAX

        raise InputError(f"{path}: the key 'model' is missing; name one of {', '.join(BUILT_IN)} or 'file.py:object'.")
    elif not contents.experiments:
        raise InputError(f"{path}: [[experiments]] is missing; give at least one.")
    return contents


def check_table(kind: type[T], given: Any, where: str) -> T:
    """Return a table; raise InputError with the key that is wrong.

    Parameters
    ----------
    kind : type
    given : object
    where : str
        Where it is given, for messages.
    """
    try:
        return kind.model_validate(given)
    except pydantic.ValidationError as error:
        raise InputError(f"{where}: {_describe_error(error, kind)}") from error


def _describe_error(error: pydantic.ValidationError, kind: type[Table]) -> str:
    """Return the first error in a table as a sentence."""
    errors = sorted(error.errors(include_url=False), key=lambda e: e["type"] != "extra_forbidden")
    first = errors[0]
    table, steps, description = _follow_location(kind, first["loc"])
    key = _join_steps(steps)
    if first["type"] == "extra_forbidden":
        known = list(table.model_fields)
        close = difflib.get_close_matches(str(steps[-1]), known, n=1)
        remedy = f"did you mean {close[0]!r}?" if close else f"known here are {', '.join(known)}."
        sentence = f"unknown key {key}; {remedy}"
    elif first["type"] == "missing":
        sentence = f"the key {key} is missing: {description}."
    else:
        sentence = f"{key} {_rephrase(first)}; got {_shorten(first['input'])} ({description})."
    different = {_join_steps(_follow_location(kind, e["loc"])[1]) for e in errors} - {key}
    return sentence + (f" Also wrong: {', '.join(sorted(different))}." if different else "")


def _follow_location(holder: type[Table], location: Sequence[str | int]) -> tuple[type[Table], list[str | int], str]:
    """Return the table of the key at a location, its steps without pydantic's names for unions, and its description."""
    inner: type[Table] | None = holder
    description = ""
    steps: list[str | int] = []
    is_chosen = False  # by the user, as the names of parameters are
    for step in location:
        if isinstance(step, int) or is_chosen:
            steps.append(step)
            is_chosen = False
        elif inner is not None and (step in inner.model_fields or step == location[-1]):
            steps.append(step)
            holder = inner
            field = holder.model_fields.get(step)
            annotation = field.annotation if field else None
            description = " ".join(field.description.split()) if field and field.description else ""
            inner, is_chosen = _find_table(annotation), get_origin(annotation) is dict
    return holder, steps, description


def _find_table(annotation: Any) -> type[Table] | None:
    if inspect.isclass(annotation) and issubclass(annotation, Table):
        return annotation
    return next((found for part in get_args(annotation) if (found := _find_table(part)) is not None), None)


def _join_steps(steps: Sequence[str | int]) -> str:
    """Return ``'experiments[1].data[2].file'``, counted from 1."""
    text = ""
    for step in steps:
        text += f"[{step + 1}]" if isinstance(step, int) else f".{step}" if text else step
    return repr(text)


def _rephrase(error: Any) -> str:
    """Return pydantic's message as the end of a sentence: 'Input should be a valid number' -> 'must be a number'."""
    if error["type"] in ("too_short", "too_long"):
        bound, size = next((k, v) for k, v in error["ctx"].items() if k in ("min_length", "max_length"))
        return f"must have at {'least' if bound == 'min_length' else 'most'} {size} entries"
    message = error["msg"][:1].lower() + error["msg"][1:]
    for old, new in (("input should be", "must be"), ("a valid ", "a "), ("dictionary", "table"), (" or instance", "")):
        message = message.replace(old, new)
    return re.sub(r" of \w+Table$", "", message)


def _shorten(given: Any) -> str:
    text = repr(given)
    return text if len(text) <= 60 else f"{text[:57]}..."
