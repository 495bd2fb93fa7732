"""Is the default ever worse than one local fit? ``python -m benchmarks harm``

Every example and every problem of `benchmarks.starts` is fitted from its own guess, by one local fit and by
`switchfit.estimate` as it comes, each problem in a process of its own. Rules: the default raises only where the local
fit does; its J is at most that of the local fit (and a part of 1e-9 more); what comes after the local fit takes at most
2 s, or 20 times the local fit where that is more. Times are those of the processor; the local fit is warm.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import switchfit as sf
from benchmarks.report import RESULTS, format_table
from benchmarks.starts.problems import PROBLEMS, build_case
from switchfit.io.problem_file.loading import load_problem
from switchfit.io.user_files import load_object

EXAMPLES = Path(__file__).parent.parent / "examples"
WITHOUT_SEQUENCE = ("covid/search.toml",)
"""Nothing can be fitted before the sequence is found."""
IN_PYTHON = (
    "own_model.py:problem",
    "uncertainty.py:problem",
    "ball/ball.py:make_problem",
    "covid/covid.py:make_problem",
    "heaters/heaters.py:make_problem",
    "heaters/order.py:make_problem",
    "husky/husky.py:make_problem",
    "husky/husky.py:make_commanded",
    "toss/release.py:make_problem",
    "tosses/tosses.py:make_problem",
)
"""Examples without a problem file."""

COST, SECONDS, TIMES = 1e-9, 2.0, 20.0
"""By which part J may be above that of the local fit; what may follow the local fit, in s and in its own time."""

FITS = ("local", "local", "auto")
"""Strategies in turn; the first one compiles."""

HEADER = ("problem", "unknowns", "local: J", "verdict", "s", "default: J", "verdict", "s", "broken")
RULES = ("raises", "J", "time")

Row = dict[str, dict[str, Any]]
"""What became of the "local" and "auto" fits: cost, verdict, seconds, unknowns; or an error, perhaps by the limit."""


def list_problems() -> dict[str, Callable[[], sf.Problem]]:
    """Return a function for each problem, by name."""
    files = {str(path.relative_to(EXAMPLES)): partial(_load, path) for path in sorted(EXAMPLES.rglob("*.toml"))}
    files = {name: load for name, load in files.items() if name not in WITHOUT_SEQUENCE}
    objects = {name: partial(_build, name) for name in IN_PYTHON}
    return {**files, **objects, **{name: partial(_take, name) for name in PROBLEMS}}


def _load(path: Path) -> sf.Problem:
    return load_problem(path).problem


def _build(name: str) -> sf.Problem:
    folder, _, reference = name.rpartition("/")
    found = load_object(reference, EXAMPLES / folder, "problem")
    return found() if callable(found) else found


def _take(name: str) -> sf.Problem:
    return build_case(name, 1).problem


def fit_all(name: str, sender: Connection) -> None:
    """Send what becomes of each of `FITS` of a problem."""
    for strategy in FITS:
        sender.send(fit(name, strategy))


def fit(name: str, strategy: str) -> dict[str, Any]:
    """Fit a problem from its own guess; an error is an outcome like any other."""
    began = time.process_time()
    try:
        problem = list_problems()[name]()
        began = time.process_time()
        found = sf.estimate(problem, strategy=strategy)
        outcome: dict[str, Any] = {"cost": found.cost, "verdict": found.verdict.level, "unknowns": len(found.theta)}
    except Exception as error:
        outcome = {"error": f"{type(error).__name__}: {error}"}
    return outcome | {"seconds": time.process_time() - began}


def run_row(name: str, limit: float) -> Row:
    """Return what became of both fits of a problem, each stopped after `limit` seconds."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=fit_all, args=(name, sender), daemon=True)
    child.start()
    sender.close()
    row: Row = {}
    try:
        for strategy in FITS:
            if not receiver.poll(limit):
                row[strategy] = {"error": f"stopped after {limit:.0f} s", "seconds": limit, "stopped": True}
                break
            row[strategy] = receiver.recv()
    except EOFError:
        row[strategy] = {"error": "the process ended", "seconds": limit}
    finally:
        child.kill()
        child.join()
    return {"auto": {"error": "not begun", "seconds": 0.0}, **row}


def find_broken(row: Row) -> list[str]:
    """Return the rules that a row breaks."""
    local, default = row["local"], row["auto"]
    if "error" in local:
        return []
    late = default["seconds"] - local["seconds"] > max(SECONDS, TIMES * local["seconds"])
    raises = "error" in default and "stopped" not in default
    above = "cost" in default and not default["cost"] <= local["cost"] + COST * abs(local["cost"])
    return [rule for rule, broken in zip(RULES, (raises, above, late), strict=True) if broken]


def describe(name: str, row: Row) -> tuple[str, ...]:
    """Return the row of the table."""
    entries = []
    for fit in (row["local"], row["auto"]):
        error = fit.get("error", "").partition("\n")[0].replace("|", "/")[:80]
        entries += [error, ""] if error else [f"{fit['cost']:.10g}", fit["verdict"]]
        entries.append(f"{fit['seconds']:.3f}")
    return (name, str(row["local"].get("unknowns", "")), *entries, ", ".join(find_broken(row)))


def main(arguments: list[str]) -> None:
    """Fit all problems; print the table and write it after each row."""
    problems = list(list_problems())
    parser = argparse.ArgumentParser(prog="python -m benchmarks harm", description=__doc__.partition("\n")[0])
    parser.add_argument("--problems", metavar="A;B", help=f"only these of: {'; '.join(problems)}")
    parser.add_argument("--limit", type=float, default=120.0, metavar="S", help="seconds after which a fit is stopped")
    parser.add_argument("--folder", type=Path, default=RESULTS, help="where the table is kept")
    options = parser.parse_args(arguments)
    names = options.problems.split(";") if options.problems else problems
    if unknown := [name for name in names if name not in problems]:
        parser.error(f"no such problem: {'; '.join(unknown)}; there are {'; '.join(problems)}")
    options.folder.mkdir(parents=True, exist_ok=True)
    rows: dict[str, Row] = {}
    lines: list[str] = []
    try:
        for number, name in enumerate(names, start=1):
            rows[name] = run_row(name, options.limit)
            lines = write_results(rows, options.folder / "harm.md")
            print(f"{number} of {len(names)}: {' | '.join(describe(name, rows[name]))}", file=sys.stderr)
    except KeyboardInterrupt:
        print(f"stopped after {len(rows)} of {len(names)} problems", file=sys.stderr)
    print("\n".join(lines))


def write_results(rows: dict[str, Row], path: Path) -> list[str]:
    """Write the table and the number of rows that break each rule; return the lines."""
    broken = [rule for row in rows.values() for rule in find_broken(row)]
    counts = ", ".join(f"{rule}: {broken.count(rule)}" for rule in RULES)
    lines = format_table(HEADER, [describe(name, row) for name, row in rows.items()])
    lines += ["", f"Rows of {len(rows)} that break a rule: {counts}."]
    path.write_text("\n".join(["# Default and local fit", "", *lines, ""]), encoding="utf-8")
    return lines
