"""The command ``python -m benchmarks sharp``."""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import machine
from benchmarks.report import RESULTS

SHOWN = {"local": "switchfit, local", "auto": "switchfit, default", "scipy": "SciPy"}

ABOUT = (
    "Right: J of the end, integrated anew by SciPy with stops at all corners, is within 0.1 % + 0.1 of the best known. "
    "Total: processor time of all starts, compilation included; a start: its median. Called good: ends that are not "
    "right, although the verdict is good. Left out: starts for which there was no time. SciPy: "
    "`least_squares` with differences of LSODA, at its best."
)

Outcome = dict[str, Any]


def main(arguments: list[str]) -> None:
    """Fit all problems from all starts with all methods; the table is written anew after each of them."""
    cores = machine.use_one_core()  # before JAX starts its threads
    from benchmarks.sharp.methods import METHODS
    from benchmarks.sharp.problems import PROBLEMS
    from switchfit.runtime.files import write_atomically

    parser = argparse.ArgumentParser(prog="python -m benchmarks sharp", description=__doc__)
    parser.add_argument("--problems", metavar="A,B", help=f"only these of: {', '.join(PROBLEMS)}")
    parser.add_argument("--methods", metavar="A,B", help=f"only these of: {', '.join(METHODS)}")
    parser.add_argument("--starts", type=int, default=100, metavar="N")
    parser.add_argument("--seconds", type=float, default=600.0, help="for all starts of a problem with a method")
    parser.add_argument("--folder", type=Path, default=RESULTS, help="where the table and the outcomes are written")
    options = parser.parse_args(arguments)
    problems = options.problems.split(",") if options.problems else list(PROBLEMS)
    methods = options.methods.split(",") if options.methods else list(METHODS)
    for what, given, there in (("problem", problems, PROBLEMS), ("method", methods, METHODS)):
        if unknown := [name for name in given if name not in there]:
            parser.error(f"no such {what}: {', '.join(unknown)}; there are {', '.join(there)}")
    if options.starts < 1:
        parser.error("--starts must be 1 or more")
    described = machine.describe(cores)
    outcomes: dict[str, dict[str, list[Outcome]]] = {}
    options.folder.mkdir(exist_ok=True)
    for name in problems:
        outcomes[name] = fit_all(name, methods, options.starts, options.seconds)
        lines = write_table(outcomes, methods, options.starts, described)
        write_atomically("\n".join(["# Models with corners", "", *lines, ""]), options.folder / "sharp.md")
        content = {"machine": described, "starts": options.starts, "outcomes": outcomes}
        write_atomically(json.dumps(content, indent=1), options.folder / "sharp.json")
    print("\n".join(lines))
    print(f"written to {options.folder / 'sharp.md'} and .json")


def fit_all(name: str, methods: list[str], count: int, seconds: float) -> dict[str, list[Outcome]]:
    """Return the outcomes of a problem by method, each of them judged; no start begins after so many seconds."""
    from benchmarks.sharp.case import is_right
    from benchmarks.sharp.methods import METHODS, fit_with_scipy
    from benchmarks.sharp.problems import PROBLEMS

    case = PROBLEMS[name]()
    starts = case.draw_starts(count)
    costs = [case.judge(case.truth), case.judge(fit_with_scipy(case, case.truth).theta)]
    found: dict[str, list[Outcome]] = {}
    for method in methods:
        began, found[method] = time.monotonic(), []
        for k, start in enumerate(starts):
            if time.monotonic() - began > seconds:
                break
            report_progress(f"{name}, {method}: start {k + 1} of {count}")
            found[method].append(fit_one(case, METHODS[method], start))
    report_progress("")
    ends = [end for all_ends in found.values() for end in all_ends]
    best = min(costs + [end["judged"] for end in ends if end["judged"] is not None])
    for end in ends:
        end["right"] = end["judged"] is not None and is_right(end["judged"], best)
    return found


def fit_one(case: Any, fit: Any, start: np.ndarray) -> Outcome:
    """Fit from a start and judge the end; an error is an outcome like any other."""
    began = time.process_time()
    outcome: Outcome = {"start": start.tolist(), "judged": None, "good": False, "error": False}
    try:
        end = fit(case, start)
        outcome |= {"theta": end.theta.tolist(), "cost": float(end.cost), "good": end.good, "said": end.said}
    except Exception as error:
        outcome |= {"error": True, "said": f"{type(error).__name__}: {error}".splitlines()[0]}
    outcome["seconds"] = time.process_time() - began
    if "theta" in outcome:
        try:
            judged = case.judge(np.array(outcome["theta"]))
            outcome["judged"] = judged if np.isfinite(judged) else None
        except (ArithmeticError, ValueError, TimeoutError) as error:
            outcome["said"] += f" (cannot be judged: {error})"
    return outcome


def write_table(
    outcomes: dict[str, dict[str, list[Outcome]]], methods: list[str], count: int, described: dict[str, Any]
) -> list[str]:
    """Return the lines of the table, and below it what was said of ends that are not right."""
    header = ["problem"]
    for method in methods:
        header += [f"{SHOWN[method]}: right", "total", "a start"]
        header += ["called good", "errors"] if method != "scipy" else []
    lines = [ABOUT, "", "| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    notes = []
    for name, found in outcomes.items():
        cells = [name]
        for method in methods:
            cells += count_row(found[method], method, count)
            notes += [f"- {name}, {SHOWN[method]}: {text}" for text in list_wrong(found[method])]
        lines.append("| " + " | ".join(cells) + " |")
    if len(outcomes) > 1:
        together = {method: [end for found in outcomes.values() for end in found[method]] for method in methods}
        row = [cell for method in methods for cell in count_row(together[method], method, count * len(outcomes))]
        lines.append("| " + " | ".join(["all", *row]) + " |")
    packages = ", ".join(f"{package} {number}" for package, number in described["packages"].items())
    where = f"One core of {described['cpu']}; {described['system']}, Python {described['python']}; {packages}."
    return [*lines, "", *notes, "", where]


def count_row(ends: list[Outcome], method: str, count: int) -> list[str]:
    """Return the cells of a method, of `count` starts."""
    seconds, left = [end["seconds"] for end in ends], count - len(ends)
    cells = [f"{sum(end['right'] for end in ends)} of {len(ends)}" + (f" ({left} left out)" if left else "")]
    cells += [f"{sum(seconds):.1f} s", f"{1e3 * statistics.median(seconds):.0f} ms"]
    if method != "scipy":
        cells += [str(sum(end["good"] and not end["right"] for end in ends)), str(sum(end["error"] for end in ends))]
    return cells


def list_wrong(ends: list[Outcome]) -> list[str]:
    """Return what was most often said of ends that are not right."""
    said = Counter(shorten(end["said"]) for end in ends if not end["right"])
    return [f"{number} times {text}" for text, number in said.most_common(3)]


def shorten(text: str) -> str:
    """Return the first line of a text without its numbers, so that equal statements are counted together."""
    words = text.splitlines()[0].split()
    return " ".join("…" if any(letter.isdigit() for letter in word) else word for word in words)[:160]


def report_progress(text: str) -> None:
    """Show a line on the terminal, in the place of the last one."""
    if sys.stderr.isatty():
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)
    elif text:
        print(text, file=sys.stderr, flush=True)
