"""Every experiment and figure of Section V of the paper, with its numbers compared to ours.

One module per part. Each has ``compute(quick, folder, say)``, which returns results as plain numbers and lists,
``draw(found)``, which draws figures from these alone, and ``rows(found)``, lines of the table. `run` runs all parts.

Run all parts: figures, ``results.json``, and the table that compares the paper's numbers with ours.
"""

from __future__ import annotations

import hashlib
import json
import secrets
import shutil
import time
from collections.abc import Mapping
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

from switchfit.paper import convergence, drawing, horizon, lti, magic, noise, starts, trials
from switchfit.paper.vehicle import Found, Part, Row, Say
from switchfit.runtime.errors import get_first_line
from switchfit.runtime.files import set_aside, write_atomically

#: Name -> part, in the order of the paper.
PARTS: Mapping[str, Part] = MappingProxyType(
    {
        "vehicle": cast(Part, drawing),
        "lti": cast(Part, lti),
        "magic-formula": cast(Part, magic),
        "convergence": cast(Part, convergence),
        "noise": cast(Part, noise),
        "trials": cast(Part, trials),
        "starts": cast(Part, starts),
        "horizon": cast(Part, horizon),
    }
)
RESULTS, TABLE = "results.json", "table.md"
FINISHED = ".finished-"
"""Prefix of the name of the hidden folder when it is no longer needed."""


def run(out: Path, *, quick: bool = False, only: str | None = None, say: Say | None = None) -> dict[str, Any]:
    """Run every part of the paper, or one, and write the results.

    Parameters
    ----------
    out : Path
        Folder for the figures (PDF and PNG), ``results.json`` and ``table.md``; created if it does not exist.
    quick : bool
        Fewer repetitions of the statistics; everything else is the same.
    only : str, optional
        One name of `PARTS`; the other parts in ``results.json`` and the table are unchanged.
    say : callable, optional
        Called with a line of text for progress.

    Returns
    -------
    dict
        The content of ``results.json``.

    Raises
    ------
    ValueError
        For an unknown part.
    OSError
        If a file cannot be written.

    Notes
    -----
    Finished parts are stored in a hidden folder in `out` until the run is complete. After an interruption (by
    KeyboardInterrupt), the same call resumes. If a file in that folder is damaged, it is renamed with a warning, and
    its part is computed again.
    """
    if only is not None and only not in PARTS:
        raise ValueError(f"there is no part {only!r}; the parts are {', '.join(PARTS)}.")
    tell = say or (lambda text: None)
    names = list(PARTS) if only is None else [only]
    unfinished = out / f".unfinished-{version('switchfit')}-{'quick' if quick else 'full'}-{only or 'all'}"
    for left in out.glob(f"{FINISHED}*"):  # left by a run that was killed while it removed its folder
        shutil.rmtree(left, ignore_errors=True)
    unfinished.mkdir(parents=True, exist_ok=True)
    results = _earlier(out / RESULTS) if only is not None else {}
    for number, name in enumerate(names, start=1):
        part, place = PARTS[name], f"[{number}/{len(names)}] {PARTS[name].TITLE}"
        kept = unfinished / f"{name}.json"
        entry = _read_kept(kept)
        if entry is not None:
            tell(f"{place}: done before the interruption")
        else:
            began = time.perf_counter()
            found = part.compute(quick, unfinished / name, lambda text, place=place: tell(f"{place}: {text}"))  # type: ignore[misc]  # mypy cannot infer the default
            entry = {"quick": quick, "seconds": round(time.perf_counter() - began, 1), "found": found}
            write_atomically(json.dumps({"entry": entry, "digest": _digest(entry)}), kept)
        results[name] = entry
        for title, figure in part.draw(entry["found"]).items():
            for kind in ("pdf", "png"):
                _save(figure, out / f"{title}.{kind}")
    results = {name: results[name] for name in PARTS if name in results}
    write_atomically(_lines(results), out / RESULTS)
    write_atomically(table(results), out / TABLE)
    finished = unfinished.rename(out / f"{FINISHED}{secrets.token_hex(4)}")  # atomically
    shutil.rmtree(finished)
    return results


def table(results: Mapping[str, Found]) -> str:
    """Return a Markdown table of the paper's numbers and ours, from the content of ``results.json``."""
    lines = ["| claim | paper | switchfit | remark |", "|---|---|---|---|"]
    for name, entry in results.items():
        lines += [_line(row) for row in PARTS[name].rows(entry["found"])]
    seconds = sum(entry["seconds"] for entry in results.values())
    fewer = [name for name, entry in results.items() if entry["quick"]]
    note = f"switchfit {version('switchfit')}, {seconds:.0f} s in all."
    if fewer:
        note += f" With fewer repetitions (--quick): {', '.join(fewer)}."
    return "\n".join([*lines, "", note, ""])


def _lines(results: Mapping[str, Found]) -> str:
    """Return JSON with a line for each part."""
    return "{\n" + ",\n".join(f"{json.dumps(name)}: {json.dumps(entry)}" for name, entry in results.items()) + "\n}\n"


def _line(row: Row) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |"


def _read_kept(path: Path) -> dict[str, Any] | None:
    """Return the stored entry of a finished part; None if it is missing, or damaged and set aside."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    try:
        kept = json.loads(content)
        entry: dict[str, Any] = kept["entry"]
        if kept["digest"] == _digest(entry):
            return entry
        reason = "its content does not match its digest"
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        reason = f"it cannot be read ({get_first_line(error)})"
    set_aside(path, reason, "This part is computed again.")
    return None


def _digest(entry: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(entry).encode()).hexdigest()


def _earlier(path: Path) -> dict[str, Any]:
    """Return results of parts that were run before; empty if the file is missing, or damaged and set aside."""
    try:
        earlier = json.loads(path.read_bytes())
    except FileNotFoundError:
        return {}
    except (ValueError, RecursionError) as error:
        set_aside(path, f"it is not valid JSON ({get_first_line(error)})", "The other parts have to be computed again.")
        return {}
    fields = {"quick": bool, "seconds": float, "found": dict}
    for name, entry in earlier.items() if isinstance(earlier, dict) else [("", None)]:
        if name not in PARTS or not isinstance(entry, dict) or {k: type(v) for k, v in entry.items()} != fields:
            set_aside(path, f"{name!r} is not a part with its results", "The other parts have to be computed again.")
            return {}
    return earlier


def _save(figure: Any, path: Path) -> None:
    """Write a figure to a file, whole or not at all."""
    content = BytesIO()
    figure.savefig(content, dpi=200, format=path.suffix[1:])
    write_atomically(content.getvalue(), path)


__all__ = ["PARTS", "run"]
