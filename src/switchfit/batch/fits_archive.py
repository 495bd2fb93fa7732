"""The archive of many fits: which of their fields are arrays, and the best estimate in its header.

It holds one array for each array of `Fits` under the name of its field, ``header``, the JSON of everything else (UTF-8
bytes), and the digest of `switchfit.batch.archives`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import make_dataclass, replace
from typing import Any, get_type_hints

from switchfit.estimation.estimates import Estimate
from switchfit.io.saved_fits import parse_fit, write_fit
from switchfit.runtime.json_records import find_dtype
from switchfit.uncertainty.certificate import certify

FITS_FORMAT = "switchfit fits"
FITS_VERSION = 3


def split_fields(kind: type[Any]) -> tuple[list[str], type[Any]]:
    """Return the names of the arrays of a class, and a dataclass of its other fields without the best estimate."""
    hints = {name: hint for name, hint in get_type_hints(kind).items() if name != "best"}
    # By their types: a new field of `Fits` is saved without a line here.
    declared = [name for name, hint in hints.items() if find_dtype(hint) is not None]
    return declared, make_dataclass(kind.__name__, [item for item in hints.items() if item[0] not in declared])


def describe_best(best: Estimate) -> dict[str, Any]:
    """Return an estimate as the content of its file; without the check by the paper's equations, if it was not done.

    Parameters
    ----------
    best : Estimate
    """
    return write_fit(best.complete(), best.known_certificate or certify(best, None))


def load_best(content: Mapping[str, object] | None) -> Estimate | None:
    """Return the estimate with the content of its file; None if there is none.

    Parameters
    ----------
    content : mapping or None
        As `describe_best` returned it.
    """
    if content is None:
        return None
    fit, certificate = parse_fit(content)
    return replace(Estimate.take_over(fit), saved_certificate=certificate)
