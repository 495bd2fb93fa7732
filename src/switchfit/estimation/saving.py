"""Save fits as JSON files that can be read without switchfit, and read them without losing a bit.

A file holds ``{"verdict": {...}, "format": "switchfit fit", "version": 11, "seal": "...", "fit": {...}, "certificate":
{...}}`` with the fields of `Verdict`, `Fit` and `Certificate` under their own names. The verdict, with its line of
text, is meant for readers of the file; `load` computes it again from the rest. ``"provenance"`` holds the fields of
`Provenance`: what the fit was made from. Files without it are read too. `runtime.files` says how numbers, arrays and
dataclasses are written.

The seal is a digest of fit and certificate: a file in which a number was changed, or lost, is refused.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from switchfit.estimation.provenance import Provenance, make_relative
from switchfit.fit.result import Fit
from switchfit.runtime.json_documents import write_document
from switchfit.runtime.json_records import from_json, to_json
from switchfit.uncertainty.certificate import Certificate
from switchfit.uncertainty.verdict import Verdict, judge

FIT_FORMAT = "switchfit fit"
FIT_VERSION = 11


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
        folder = provenance.folder and make_relative(provenance.folder, path.resolve().parent)
        content["provenance"] = to_json(replace(provenance, folder=folder), Provenance)
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
        "format": FIT_FORMAT,
        "version": FIT_VERSION,
        "seal": _compute_seal(sealed),
        **sealed,
    }


def _compute_seal(content: Mapping[str, Any]) -> str:
    """Return a digest of the fit and the certificate in the content of a file, whatever its layout."""
    sealed = [content.get("fit"), content.get("certificate")]
    return hashlib.sha256(json.dumps(sealed, sort_keys=True).encode()).hexdigest()


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
    if not isinstance(content, Mapping) or content.get("seal") != _compute_seal(content):
        raise ValueError("its content is not what was written")
    return from_json(Fit, content["fit"], "fit"), from_json(Certificate, content["certificate"], "certificate")
