"""Read a problem file into checked tables, and say in a sentence what is wrong with it."""

from __future__ import annotations

import difflib
import inspect
import re
import reprlib
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import get_args, get_origin

import pydantic

from switchfit.io.logs.files import ENDINGS
from switchfit.io.problem_file.tables import Contents, TomlTable, describe_keys
from switchfit.runtime.errors import InputError
from switchfit.runtime.files import explain_read_errors


def read_contents(path: Path, text: str | None = None) -> tuple[str, Contents]:
    """Return the text of a problem file and its checked tables; raise InputError with the key that is wrong.

    Parameters
    ----------
    path : Path
    text : str, optional
        Instead of what the file contains.
    """
    with explain_read_errors(path, "problem file", "the problem file"):
        data = path.read_bytes() if text is None else text.encode()
    try:
        text = data.decode()
        given = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # no text, no TOML, a number with thousands of digits
        is_log = path.name.lower().endswith(ENDINGS)
        remedy = f" If it is a log, begin with: switchfit init NAME --from {path}" if is_log else ""
        raise InputError(f"{path} is not valid TOML: {error}.{remedy}") from error
    try:
        contents = Contents.model_validate(given)
    except pydantic.ValidationError as error:
        raise InputError(f"{path}: {_describe_error(error)}") from error
    # Which tables a file needs depends on others, which pydantic's fields cannot say.
    if contents.problem is not None:
        others = [key for key in ("model", "parameters", "experiments") if key in given]
        if others:
            raise InputError(f"{path}: 'problem' replaces everything but options; leave out {' and '.join(others)}.")
    elif contents.model is None:
        from switchfit.models import BUILT_IN  # here, since it imports JAX

        raise InputError(f"{path}: the key 'model' is missing; name one of {', '.join(BUILT_IN)} or 'file.py:object'.")
    elif not contents.experiments:
        raise InputError(f"{path}: [[experiments]] is missing; give at least one.")
    return text, contents


def _describe_error(error: pydantic.ValidationError) -> str:
    """Return the first error in a file as a sentence."""
    # A misspelt key first: of two errors, it explains why another key is missing.
    errors = sorted(error.errors(include_url=False), key=lambda e: e["type"] != "extra_forbidden")
    first = errors[0]
    table, field, key = _follow_location(first["loc"])
    if first["type"] == "extra_forbidden":
        known = list(table.model_fields)
        close = difflib.get_close_matches(field, known, n=1)
        remedy = f"did you mean {close[0]!r}?" if close else f"known here are {', '.join(known)}."
        sentence = f"unknown key {key}; {remedy}"
    else:
        description = describe_keys(table)[field]
        sentence = f"{key} {_rephrase(first['msg'])}; got {reprlib.repr(first['input'])} ({description})."
        if first["type"] == "missing":
            sentence = f"the key {key} is missing: {description}."
    # One place once: of a union, pydantic reports an error for each of its members.
    different = {_follow_location(each["loc"])[2] for each in errors} - {key}
    return sentence + (f" Also wrong: {', '.join(sorted(different))}." if different else "")


def _follow_location(location: Sequence[str | int]) -> tuple[type[TomlTable], str, str]:
    """Return the table of the key at a location, the key, and its place, ``'experiments[1].data[2].file'``.

    pydantic's names for unions are left out.
    """
    holder: type[TomlTable] = Contents
    inner: type[TomlTable] | None = Contents
    key = place = ""
    is_chosen = False  # by the user, as the names of parameters are
    for step in location:
        # Counted from 1, as one counts the tables in the file.
        if isinstance(step, int):
            place += f"[{step + 1}]"
        elif is_chosen:
            place += f".{step}"
            is_chosen = False
        # Steps that are neither keys nor numbers are the tags of unions and the names of validators.
        elif inner is not None and (step in inner.model_fields or step == location[-1]):
            place += f".{step}" if place else step
            holder, key = inner, step
            field = holder.model_fields.get(key)
            annotation = field.annotation if field else None
            inner, is_chosen = _find_table(annotation), get_origin(annotation) is dict
    return holder, key, repr(place)


def _find_table(annotation: object) -> type[TomlTable] | None:
    if inspect.isclass(annotation) and issubclass(annotation, TomlTable):
        return annotation
    return next((found for part in get_args(annotation) if (found := _find_table(part)) is not None), None)


def _rephrase(message: str) -> str:
    """Return pydantic's message as the end of a sentence: 'Input should be a valid number' -> 'must be a number'."""
    message = re.sub(r"^\w+ should", "must", message).replace("dictionary", "table").replace("a valid ", "a ")
    return re.sub(r" or instance of \w+$", "", message)
