"""Save many fits as one NumPy archive, and load them without losing a bit.

A file holds one array for each array of `Fits` under the name of its field, ``header``, the JSON of everything else
(UTF-8 bytes), and ``seal``, a digest of all of these, by which damage is noticed. Nothing in it is pickled.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, make_dataclass
from pathlib import Path
from typing import Any, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from switchfit.batch.chunks import read_arrays, write_arrays
from switchfit.estimation.estimator import Estimate
from switchfit.estimation.saved import parse_fit, write_fit
from switchfit.fit.result import Fit
from switchfit.runtime.json_records import from_json, to_json
from switchfit.uncertainty.certificate import certify

FORMAT = "switchfit fits"
VERSION = 1


def save_fits(fits: Any, path: Path) -> None:
    """Write fits to a file, whole or not at all.

    Parameters
    ----------
    fits : Fits
        Or of a class derived from it.
    path : Path
        An existing file is replaced.

    Raises
    ------
    OSError
        If the file cannot be written; an existing one is then left as it was.
    """
    kind = type(fits)
    arrays, rest = _split_fields(kind)
    content = {"format": FORMAT, "version": VERSION, "kind": kind.__name__, "fits": to_json(fits, rest)}
    if "best" in get_type_hints(kind):
        content["best"] = None if fits.best is None else describe_best(fits.best)
    header = np.frombuffer(json.dumps(content, allow_nan=False).encode(), dtype=np.uint8)
    whole = {name: getattr(fits, name) for name in arrays} | {"header": header}
    write_arrays(whole, path, np.savez_compressed)


def load_fits(kind: type[Any], path: Path) -> Any:
    """Read what `save_fits` wrote; every field is equal, and arrays have the same bits, dtype and shape.

    Parameters
    ----------
    kind : type
        `Fits` or a class derived from it: the file must hold fits of that class, or of one derived from it.
    path : Path

    Raises
    ------
    OSError
        If there is no such file (FileNotFoundError) or it cannot be read.
    ValueError
        If it was not written by `save_fits`, is of another version, holds another kind of fits, or is damaged.
    """
    arrays, content = _read_archive(path)
    version, name = content.get("version"), content.get("kind")
    if version != VERSION:
        raise ValueError(
            f"{path} holds fits in version {version!r} of their format; this switchfit reads version {VERSION}. Read "
            "it with the switchfit that wrote it."
        )
    kinds = {each.__name__: each for each in (kind, *kind.__subclasses__())}
    if name not in kinds:
        raise ValueError(f"{path} holds the kind of fits {name!r}, not {kind.__name__}: sf.Fits.load reads every kind.")
    try:
        return _build_fits(kinds[name], arrays, content)
    except (ValueError, OverflowError, RecursionError, MemoryError) as error:
        raise ValueError(f"{path} is damaged: {error}.") from error


def _read_archive(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the arrays of a file and its header; ValueError if it was not written by `save_fits` as it is."""
    arrays, reason = read_arrays(path)
    if arrays and reason:
        raise ValueError(f"{path} is damaged: {reason}.")
    try:
        content = json.loads(arrays.pop("header").tobytes())
        if content["format"] != FORMAT:
            reason = f"its header has no format {FORMAT!r}"
    except (KeyError, TypeError, ValueError, RecursionError):
        reason = reason or "it has no header"
    if reason:
        raise ValueError(f"{path} does not hold saved fits ({reason}).")
    return arrays, content


def _build_fits(kind: type[Any], arrays: dict[str, NDArray[Any]], content: dict[str, Any]) -> Any:
    declared, rest = _split_fields(kind)
    if missing := sorted(set(declared) ^ set(arrays)):
        what = "lacks the array" if missing[0] in declared else "has the unknown array"
        raise ValueError(f"it {what} {missing[0]} for fits of the kind {kind.__name__}")
    nested = {"best": load_best(content.get("best"))} if "best" in get_type_hints(kind) else {}
    return kind(**arrays, **vars(from_json(rest, content.get("fits"), "fits")), **nested)


def _split_fields(kind: type[Any]) -> tuple[list[str], type[Any]]:
    """Return the names of the arrays of a class, and a dataclass of its other fields without the best estimate."""
    hints = {name: hint for name, hint in get_type_hints(kind).items() if name != "best"}
    declared = [name for name, hint in hints.items() if get_origin(hint) is np.ndarray]
    return declared, make_dataclass(kind.__name__, [item for item in hints.items() if item[0] not in declared])


def describe_best(best: Estimate) -> dict[str, Any]:
    """Return an estimate as the content of its file; without the check by the paper's equations, if it was not done.

    Parameters
    ----------
    best : Estimate
    """
    return write_fit(best.complete(), best.known_certificate or certify(best, None))


def load_best(content: Any) -> Estimate | None:
    """Return the estimate with the content of its file; None if there is none.

    Parameters
    ----------
    content : mapping or None
        As `describe_best` returned it.
    """
    if content is None:
        return None
    if not isinstance(content, Mapping):
        raise ValueError("best must be an object")
    fit, certificate = parse_fit(content)
    return Estimate(**{f.name: getattr(fit, f.name) for f in fields(Fit)}, saved_certificate=certificate)
