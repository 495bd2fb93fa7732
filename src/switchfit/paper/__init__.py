"""Every experiment and figure of Section V of the paper, with its numbers compared to ours.

One module per part. Each has a TITLE, ``compute(quick, folder, say)``, which returns results as plain numbers and lists
and keeps what its long studies have done in a folder, ``draw(found)``, which returns figures drawn from these alone by
the names of their files, and ``rows(found)``, lines of the table. `run` runs all parts.

Run all parts: figures, ``results.json``, and the table that compares the paper's numbers with ours.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Mapping
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from types import ModuleType
from typing import Any

from switchfit.paper import convergence, horizon, lti, magic, noise, starts, trials, vehicle
from switchfit.paper.vehicle import Found, Say
from switchfit.runtime.files import write_atomically

#: Name -> part, in the order of the paper.
PARTS: Mapping[str, ModuleType] = {
    "vehicle": vehicle,
    "lti": lti,
    "magic-formula": magic,
    "convergence": convergence,
    "noise": noise,
    "trials": trials,
    "starts": starts,
    "horizon": horizon,
}
RESULTS, TABLE = "results.json", "table.md"


def run(out: Path, *, quick: bool = False, only: str | None = None, say: Say = lambda text: None) -> dict[str, Any]:
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
    KeyboardInterrupt), the same call resumes.
    """
    if only is not None and only not in PARTS:
        raise ValueError(f"there is no part {only!r}; the parts are {', '.join(PARTS)}.")
    names = list(PARTS) if only is None else [only]
    unfinished = out / f".unfinished-{version('switchfit')}-{'quick' if quick else 'full'}-{only or 'all'}"
    unfinished.mkdir(parents=True, exist_ok=True)
    is_kept = only is not None and (out / RESULTS).exists()
    results: dict[str, Any] = json.loads((out / RESULTS).read_bytes()) if is_kept else {}
    for number, name in enumerate(names, start=1):
        part, place = PARTS[name], f"[{number}/{len(names)}] {PARTS[name].TITLE}"
        kept = unfinished / f"{name}.json"
        if kept.exists():
            entry = json.loads(kept.read_bytes())
            say(f"{place}: done before the interruption")
        else:
            began = time.perf_counter()
            found = part.compute(quick, unfinished / name, lambda text, place=place: say(f"{place}: {text}"))
            entry = {"quick": quick, "seconds": round(time.perf_counter() - began, 1), "found": found}
            write_atomically(json.dumps(entry), kept)
        results[name] = entry
        for title, figure in part.draw(entry["found"]).items():
            for kind in ("pdf", "png"):
                _save(figure, out / f"{title}.{kind}")
    results = {name: results[name] for name in PARTS if name in results}
    write_atomically(_lines(results), out / RESULTS)
    write_atomically(table(results), out / TABLE)
    shutil.rmtree(unfinished)
    return results


def table(results: Mapping[str, Found]) -> str:
    """Return a Markdown table of the paper's numbers and ours, from the content of ``results.json``."""
    lines = ["| claim | paper | switchfit | remark |", "|---|---|---|---|"]
    for name, entry in results.items():
        for row in PARTS[name].rows(entry["found"]):
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |")
    seconds = sum(entry["seconds"] for entry in results.values())
    fewer = [name for name, entry in results.items() if entry["quick"]]
    note = f"switchfit {version('switchfit')}, {seconds:.0f} s in all."
    if fewer:
        note += f" With fewer repetitions (--quick): {', '.join(fewer)}."
    return "\n".join([*lines, "", note, ""])


def _lines(results: Mapping[str, Found]) -> str:
    """Return JSON with a line for each part."""
    return "{\n" + ",\n".join(f"{json.dumps(name)}: {json.dumps(entry)}" for name, entry in results.items()) + "\n}\n"


def _save(figure: Any, path: Path) -> None:
    """Write a figure to a file, whole or not at all."""
    content = BytesIO()
    figure.savefig(content, dpi=200, format=path.suffix[1:])
    write_atomically(content.getvalue(), path)


__all__ = ["PARTS", "run"]
