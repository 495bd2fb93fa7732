"""Save fits as JSON files that can be read without switchfit, and load them without losing a bit.

A file holds ``{"verdict": {...}, "format": "switchfit fit", "version": 8, "seal": "...", "fit": {...}, "certificate":
{...}}`` with the fields of `Verdict`, `Fit` and `Certificate` under their own names. The verdict, with its line of
text, and the "transition_dates" that a fit to dates has beside them are meant for readers of the file; `load` computes
them again from the rest. ``"provenance"`` holds the fields of `Provenance`: what the fit was made from. Files without
it are read too.

`runtime.json_records` says how numbers, arrays and dataclasses are written.

The seal is a digest of fit and certificate: a file in which a number was changed, or lost, is refused.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from switchfit.estimation.provenance import Provenance
from switchfit.fit.result import Fit
from switchfit.runtime.json_records import from_json, read_document, to_json, write_document
from switchfit.uncertainty.certificate import Certificate
from switchfit.uncertainty.verdict import Verdict, judge

FORMAT = "switchfit fit"
VERSION = 8


def save_fit(fit: Fit, certificate: Certificate, path: Path, provenance: Provenance | None = None) -> None:
    """Write a fit to a file, whole or not at all.

    Parameters
    ----------
    fit : Fit
        Only the fields of `Fit` are written, also for a subclass.
    certificate : Certificate
    path : Path
        An existing file is replaced.
    provenance : Provenance, optional
        What the fit was made from.

    Raises
    ------
    OSError
        If the file cannot be written; an existing one is then left as it was.
    """
    content = write_fit(fit, certificate)
    if provenance is not None:
        content["provenance"] = to_json(provenance.place_beside(Path(path)), Provenance)
    write_document(content, Path(path))


def write_fit(fit: Fit, certificate: Certificate) -> dict[str, Any]:
    """Return the content of the file of a fit, without its provenance.

    Parameters
    ----------
    fit : Fit
    certificate : Certificate
    """
    verdict = judge(fit, certificate)
    sealed = {"fit": to_json(fit, Fit), "certificate": to_json(certificate, Certificate)}
    return {
        "verdict": {"level": verdict.level, "text": str(verdict)} | to_json(verdict, Verdict),
        "format": FORMAT,
        "version": VERSION,
        "seal": _compute_seal(sealed),
        **_list_dates(fit),
        **sealed,
    }


def _compute_seal(content: Mapping[str, Any]) -> str:
    """Return a digest of the fit and the certificate in the content of a file, whatever its layout."""
    sealed = [content.get("fit"), content.get("certificate")]
    return hashlib.sha256(json.dumps(sealed, sort_keys=True).encode()).hexdigest()


class SavedFit(NamedTuple):
    """What a file holds; a fit that was saved without its provenance has None."""

    fit: Fit
    certificate: Certificate
    provenance: Provenance | None


def load_fit(path: Path) -> tuple[Fit, Certificate]:
    """Return the fit and the certificate of a file, see `load_saved`.

    Parameters
    ----------
    path : Path
    """
    saved = load_saved(path)
    return saved.fit, saved.certificate


def load_saved(path: Path) -> SavedFit:
    """Read what `save_fit` wrote; every field is equal, and arrays have the same bits, dtype and shape.

    Parameters
    ----------
    path : Path

    Returns
    -------
    SavedFit

    Raises
    ------
    OSError
        If there is no such file (FileNotFoundError) or it cannot be read.
    ValueError
        If it is not valid JSON, not written by switchfit, of another version, or not as it was written.
    """
    content = read_document(Path(path), "a saved estimate", FORMAT, VERSION)
    try:
        fit, certificate = parse_fit(content)
        given = content.get("provenance")
        provenance = None if given is None else from_json(Provenance, given, "provenance")
        return SavedFit(fit, certificate, None if provenance is None else provenance.find_from(Path(path)))
    except (ValueError, OverflowError, RecursionError, MemoryError) as error:
        raise ValueError(f"{path} is damaged: {error}.") from error


def _list_dates(fit: Fit) -> dict[str, Any]:
    """Return the transition times that are dates by their names, for readers of the file; {} where none is."""
    if all(trajectory.origin is None for trajectory in fit.trajectories):
        return {}
    dates = {}
    for transition in fit.transitions:
        origin = fit.trajectories[transition.experiment].origin
        date = None if origin is None else origin.find_date(transition.time, transition.unit)
        if date is not None:
            dates[transition.name] = date.isoformat()
    return {"transition_dates": dates}


def parse_fit(content: Mapping[str, Any]) -> tuple[Fit, Certificate]:
    """Return a fit and its certificate from the content of a file of this version.

    Parameters
    ----------
    content : mapping

    Raises
    ------
    ValueError
        If the content is not what `write_fit` returned.
    """
    if content.get("seal") != _compute_seal(content):
        raise ValueError("its content is not what was written")
    return from_json(Fit, content["fit"], "fit"), from_json(Certificate, content["certificate"], "certificate")
