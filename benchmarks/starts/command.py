"""The command ``python -m benchmarks starts``."""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.report import RESULTS
from benchmarks.starts.methods import list_methods
from benchmarks.starts.problems import PROBLEMS
from benchmarks.starts.study import Outcomes, digest_source, list_jobs, run_jobs
from benchmarks.starts.table import write_table


def main(arguments: list[str]) -> None:
    """Run the study, print its table and write it beside the outcomes."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks starts", description=__doc__)
    parser.add_argument("--problems", metavar="A,B", help=f"only these of: {', '.join(PROBLEMS)}")
    parser.add_argument("--methods", metavar="A,B", help=f"only these of: {', '.join(list_methods())}")
    parser.add_argument("--starts", type=int, metavar="N", help="at most so many starts a problem")
    parser.add_argument("--processes", type=int, default=1, metavar="P")
    parser.add_argument("--fresh", action="store_true", help="drop the outcomes of this version of switchfit")
    parser.add_argument("--folder", type=Path, default=RESULTS, help="where outcomes and table are kept")
    options = parser.parse_args(arguments)
    problems = options.problems.split(",") if options.problems else list(PROBLEMS)
    methods = options.methods.split(",") if options.methods else list(list_methods())
    for what, given, there in (("problem", problems, PROBLEMS), ("method", methods, list_methods())):
        if unknown := [name for name in given if name not in there]:
            parser.error(f"no such {what}: {', '.join(unknown)}; there are {', '.join(there)}")
    if (options.starts is not None and options.starts < 1) or options.processes < 1:
        parser.error("--starts and --processes must be 1 or more")
    outcomes = Outcomes(options.folder / f"starts-{digest_source()}.jsonl", options.fresh)
    run_jobs(list_jobs(problems, methods, options.starts), outcomes, options.processes)
    lines = write_table(outcomes, problems, methods, options.starts)
    print("\n".join(lines))
    outcomes.path.with_suffix(".md").write_text("\n".join(["# Starts", "", *lines, ""]), encoding="utf-8")
    print(f"written to {outcomes.path} and .md")
