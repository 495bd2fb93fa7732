"""Run all parts: figures, ``results.json``, and the table that compares the paper's numbers with ours."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any

from switchfit.paper.parts import PARTS
from switchfit.paper.table_rows import Found, Say
from switchfit.runtime.files import write_atomically

RESULTS_FILE, TABLE_FILE = "results.json", "table.md"


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
    Each part is written when it is done. Where parts are missing in ``results.json``, as after an interruption (by
    KeyboardInterrupt), the same call does these.
    """
    if only is not None and only not in PARTS:
        raise ValueError(f"there is no part {only!r}; the parts are {', '.join(PARTS)}.")
    names = list(PARTS) if only is None else [only]
    out.mkdir(parents=True, exist_ok=True)
    # Results on disk are the state: a run that was interrupted goes on behind its last part. When all parts are there,
    # and none is asked for by name, a new run begins.
    before: dict[str, Any] = json.loads((out / RESULTS_FILE).read_bytes()) if (out / RESULTS_FILE).exists() else {}
    results = before if only is not None or len(before) < len(PARTS) else {}
    if only is None:
        names = [name for name in names if name not in results or results[name]["quick"] != quick]
    for number, name in enumerate(names, start=1):
        part, began = PARTS[name], time.perf_counter()

        # Its place is bound by a default, since the loop goes on to the next one.
        def report(text: str, place: str = f"[{number}/{len(names)}] {part.title}") -> None:
            say(f"{place}: {text}")

        found = part.compute(quick, report)
        results[name] = {"quick": quick, "seconds": round(time.perf_counter() - began, 1), "found": found}
        for title, figure in part.draw(found).items():
            for kind in ("pdf", "png"):
                content = BytesIO()
                figure.savefig(content, dpi=200, format=kind)
                write_atomically(content.getvalue(), out / f"{title}.{kind}")
        # In the order of the paper, whichever part was run last.
        results = {name: results[name] for name in PARTS if name in results}
        lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(entry)}" for name, entry in results.items())  # one a part
        write_atomically(f"{{\n{lines}\n}}\n", out / RESULTS_FILE)
        write_atomically(format_comparison(results), out / TABLE_FILE)
    return results


def format_comparison(results: Mapping[str, Found]) -> str:
    """Return a Markdown table of the paper's numbers and ours, from the content of ``results.json``."""
    lines = ["| claim | paper | switchfit | remark |", "|---|---|---|---|"]
    for name, entry in results.items():
        for row in PARTS[name].list_rows(entry["found"]):
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |")
    seconds = sum(entry["seconds"] for entry in results.values())
    fewer = [name for name, entry in results.items() if entry["quick"]]
    note = f"switchfit {version('switchfit')}, {seconds:.0f} s in all."
    if fewer:
        note += f" With fewer repetitions (--quick): {', '.join(fewer)}."
    return "\n".join([*lines, "", note, ""])
