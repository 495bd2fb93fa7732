"""The command ``python -m benchmarks modes``."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from benchmarks.modes import peers, study
from benchmarks.modes.sets import SETS
from benchmarks.report import RESULTS, format_table


def main(arguments: list[str]) -> None:
    """Search all sets, print the tables and write them beside the outcomes."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks modes", description=__doc__)
    parser.add_argument("--sets", metavar="A;B", help=f"only these of: {'; '.join(SETS)}")
    parser.add_argument("--truths", type=int, metavar="N", help="at most so many of each set")
    parser.add_argument("--processes", type=int, default=1, metavar="P")
    parser.add_argument("--peers", action="store_true", help="search the linear modes with other libraries too")
    parser.add_argument("--folder", type=Path, default=RESULTS, help="where outcomes and tables are kept")
    options = parser.parse_args(arguments)
    names = options.sets.split(";") if options.sets else list(SETS)
    if unknown := [name for name in names if name not in SETS]:
        parser.error(f"no such set: {'; '.join(unknown)}; there are {'; '.join(SETS)}")
    rows, records = [], []
    for name in names:
        seeds = range(min(SETS[name][1], options.truths or SETS[name][1]))
        outcomes = study.run(name, seeds, options.processes)
        records += [study.as_record(name, seed, outcome) for seed, outcome in zip(seeds, outcomes, strict=True)]
        rows.append(study.count(name, outcomes))
        print(dict(zip(study.HEADER, rows[-1], strict=True)), flush=True)
    lines = format_table(study.HEADER, rows)
    if options.peers:
        lines += ["", *format_table(peers.HEADER, peers.run(range(min(100, options.truths or 100))))]
    print("\n".join(lines))
    options.folder.mkdir(exist_ok=True)
    (options.folder / "modes.md").write_text("\n".join(["# Mode sequences", "", *lines, ""]), encoding="utf-8")
    (options.folder / "modes.jsonl").write_text("".join(json.dumps(r) + "\n" for r in records), encoding="utf-8")
