"""The files of an online estimator: its saved state, and the journal of the updates since then.

An update is written to the journal before it begins, so that a saved state and a journal together are always all
samples.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray

ONLINE_FORMAT = "switchfit online 4"


def read_state(path: Path) -> tuple[dict[str, Any], dict[str, FloatArray]]:
    """Return the numbers and the arrays of a file; ValueError for any other."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        numbers = json.loads(arrays.pop("numbers").tobytes())
    except (ValueError, KeyError, EOFError, BadZipFile) as error:
        raise ValueError(f"{path} is not a saved online estimator ({error}).") from error
    if numbers.get("format") != ONLINE_FORMAT:
        raise ValueError(f"{path} is of another version: it has {numbers.get('format')!r}, not {ONLINE_FORMAT!r}.")
    return numbers, arrays


def append_update(path: Path, t: float, y: dict[int, FloatArray], u: ArrayLike | Mapping[str, float] | None) -> None:
    """Write an update to a journal, with the values of each sensor; it leaves the process before the update begins."""
    line = json.dumps({"t": t, "y": y, "u": u}, default=lambda value: np.asarray(value, dtype=np.float64).tolist())
    # Unbuffered: one write hands the line to the system, which keeps it when the process is killed.
    with path.open("ab", buffering=0) as file:
        file.write(line.encode() + b"\n")


def read_journal(path: Path) -> list[tuple[float, Any, Any]]:
    """Return the updates of a journal, none without a file; a last one that was cut off is taken out of it."""
    written = path.read_bytes() if path.exists() else b""
    # A line without its end was cut off by a kill; the next update would be written behind it.
    whole, _, cut_off = written.rpartition(b"\n")
    found = []
    for line in whole.splitlines():
        try:
            each = json.loads(line)
            found.append((each["t"], {int(k): values for k, values in each["y"].items()}, each["u"]))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path} is not the journal of an online estimator ({error}).") from error
    with path.open("ab") as file:
        file.truncate(len(written) - len(cut_off))
    return found
