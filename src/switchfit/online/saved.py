"""The state of an online estimator in a file, and the journal of the samples since then."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from switchfit.online.tracker import Left, Tracker
from switchfit.online.window import Start
from switchfit.problem.data import FloatArray
from switchfit.runtime.files import write_atomically
from switchfit.strategy.branching import Sequences

FORMAT = "switchfit online 1"


def pack(tracker: Tracker, others: dict[str, Any]) -> bytes:
    """Return the arrays of a tracker and its feed, and other numbers, as a file."""
    feed = tracker.feed
    arrays: dict[str, Any] = {f"feed {name}": array for name, array in feed.copy_arrays().items()}
    for place, there in enumerate(tracker.kept):
        if there is not None:
            tracker.catch_up(place, there[1])
            arrays |= {f"kept {place} {name}": array for name, array in there[0]._asdict().items()}
    arrays |= {"records": tracker.records, "declared": tracker.declared}
    if tracker.start is not None:
        arrays |= {f"start {name}": np.asarray(array) for name, array in tracker.start._asdict().items()}
    numbers = others | {"format": FORMAT, "first": tracker.first, "dropped": tracker.dropped, "left": tracker.left}
    buffer = io.BytesIO()
    np.savez(buffer, numbers=np.frombuffer(json.dumps(numbers).encode(), dtype=np.uint8), **arrays)
    return buffer.getvalue()


def read(path: Path) -> tuple[dict[str, Any], dict[str, FloatArray]]:
    """Return the numbers and the arrays of a file; ValueError for any other."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        numbers = json.loads(arrays.pop("numbers").tobytes())
    except (ValueError, KeyError, EOFError) as error:
        raise ValueError(f"{path} is not a saved online estimator ({error}).") from error
    if numbers.get("format") != FORMAT:
        raise ValueError(f"{path} is of another version: it has {numbers.get('format')!r}, not {FORMAT!r}.")
    return numbers, arrays


def unpack(tracker: Tracker, numbers: dict[str, Any], arrays: dict[str, FloatArray], path: Path) -> None:
    """Give a tracker what was saved; ValueError if that is of another problem or other settings."""
    if arrays["records"].shape != tracker.records.shape:
        raise ValueError(f"{path} was saved for another problem, or with other settings: give the same ones.")

    def part(name: str) -> dict[str, Any]:
        begin = f"{name} "
        return {key.removeprefix(begin): array for key, array in arrays.items() if key.startswith(begin)}

    tracker.feed.set_arrays(part("feed"))
    tracker.records[:] = arrays["records"]
    tracker.declared = arrays["declared"].astype(np.int64)
    for place in range(len(tracker.kept)):
        found = part(f"kept {place}")
        tracker.kept[place] = tracker.view(place, Sequences(**found)) if found else None
    if start := part("start"):
        tracker.start = Start(**start)._replace(cost=float(start["cost"]))
    tracker.first, tracker.dropped = numbers["first"], numbers["dropped"]
    tracker.left = [Left(*each) for each in numbers["left"]]


class Journal:
    """A file with a line for each update, which has left the process before the update begins.

    Parameters
    ----------
    path : Path
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        written = path.read_bytes() if path.exists() else b""
        with path.open("ab") as file:
            file.truncate(written.rfind(b"\n") + 1)  # without a line that was cut off

    def write(self, t: float, y: Any, u: Any) -> None:
        """Add an update."""
        line = json.dumps({"t": t, "y": _listed(y), "u": _listed(u)})
        with self.path.open("ab", buffering=0) as file:
            file.write(line.encode() + b"\n")

    def clear(self) -> None:
        """Forget what the saved state has."""
        write_atomically(b"", self.path)


def read_journal(path: Path) -> list[tuple[float, Any, Any]]:
    """Return the updates of a journal; the last one may have been cut off, and is left out then."""
    found = []
    for line in path.read_bytes().split(b"\n")[:-1]:
        try:
            each = json.loads(line)
            found.append((each["t"], _given(each["y"]), _given(each["u"])))
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path} is not the journal of an online estimator ({error}).") from error
    return found


def _listed(value: Any) -> Any:
    """Return a value of an update for JSON; the keys of sensors are numbers, those of channels text."""
    if isinstance(value, dict):
        return {"items": [[key, _listed(each)] for key, each in value.items()]}
    return None if value is None else np.asarray(value, dtype=np.float64).tolist()


def _given(value: Any) -> Any:
    return {key: _given(each) for key, each in value["items"]} if isinstance(value, dict) else value
