"""Count what the outcomes say: a row a problem and method."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from benchmarks.starts.case import MET_BY_BEST, Case
from benchmarks.starts.methods import why_not
from benchmarks.starts.problems import build_case
from benchmarks.starts.study import REFERENCE, Outcome, Outcomes, read_outcomes

HEADER = (
    "problem",
    "method",
    "right",
    "of these the best",
    "wrong, claims success",
    "right, does not claim it",
    "J misjudged",
    "errors",
    "evaluations, median",
    "evaluations, all",
    "a fit, median",
    "in the optimizer",
    "all starts",
)


def find_best(problem: str, case: Case, files: Iterable[Path]) -> float:
    """Return the least cost that any method and version of switchfit has found with all constraints met."""
    costs = [
        outcome["cost"]
        for path in files
        for outcome in read_outcomes(path)
        if (outcome["problem"], outcome["case"]) == (problem, case.identity)
        and "error" not in outcome
        and outcome["violation"] <= MET_BY_BEST
    ]
    return min((cost for cost in costs if cost == cost), default=float("nan"))


def count(case: Case, best: float, outcomes: list[Outcome]) -> tuple[str, ...]:
    """Return the counts of one problem and method: the row without its first two entries."""
    ends = [outcome for outcome in outcomes if "error" not in outcome]
    right = [end for end in ends if case.is_right(end["cost"], best, end["violation"])]
    wrong = [end for end in ends if not case.is_right(end["cost"], best, end["violation"])]
    exact = [end for end in right if case.is_best(end["cost"], best, end["violation"])]
    evaluations = [end["evaluations"] for end in ends]
    seconds = [outcome["seconds"] for outcome in outcomes]
    return (
        f"{len(right)} of {len(outcomes)}",
        str(len(exact)),
        f"{sum(end['claims'] for end in wrong)} of {len(wrong)}",
        str(sum(not end["claims"] for end in right)),
        str(sum(case.is_misjudged(end["said"], end["cost"]) for end in ends)),
        str(len(outcomes) - len(ends)),
        f"{statistics.median(evaluations):.0f}" if ends else "",
        str(sum(evaluations)),
        *(write_milliseconds([end[name] for end in ends]) for name in ("fitting", "optimizing")),
        f"{sum(seconds):.1f} s",
    )


def write_milliseconds(seconds: list[float]) -> str:
    """Return the median of some times; nothing of none."""
    if not seconds:
        return ""
    median = 1e3 * statistics.median(seconds)
    return f"{median:.1f} ms" if median < 100 else f"{median:.0f} ms"


def write_table(outcomes: Outcomes, problems: list[str], methods: list[str], number: int | None) -> list[str]:
    """Return the lines of the table, and below it what has to be known of the problems."""
    files = sorted(outcomes.path.parent.glob("starts-*.jsonl"))
    lines = ["| " + " | ".join(HEADER) + " |", "|" + "---|" * len(HEADER)]
    notes = []
    for problem in problems:
        case = build_case(problem, number)
        best = find_best(problem, case, files)
        reference = outcomes.found.get((problem, REFERENCE, -1, case.identity))
        notes.append(describe(problem, case, best, reference))
        for method in methods:
            if why := why_not(method, case):
                notes.append(f"- {problem}, {method} is left out: {why}")
                continue
            keys = [(problem, method, k, case.digest(k)) for k in range(len(case.starts))]
            found = [outcomes.found[key] for key in keys if key in outcomes.found]
            if found:
                lines.append("| " + " | ".join((problem, method, *count(case, best, found))) + " |")
                notes += [f"- {problem}, {method}: {text}" for text in list_errors(found)]
    return [*lines, "", *notes]


def describe(problem: str, case: Case, best: float, reference: Outcome | None) -> str:
    """Return a line about the best known cost of a problem."""
    text = f"- {problem}: {len(case.problem.theta_names)} unknowns; best known cost {best:.10g}"
    if case.noisy:
        text += f", {case.cost_near:.10g} at the truth"
    if reference is None or "error" in reference:
        return text + "; the fit from the truth failed" + (f": {reference['error']}" if reference else "")
    if not case.is_best(reference["cost"], best):
        return text + f"; the fit from the truth ends at {reference['cost']:.10g}, which is not the best"
    return text


def list_errors(outcomes: list[Outcome]) -> list[str]:
    """Return the three most frequent errors, each cut to a line."""
    errors = Counter(outcome["error"].splitlines()[0][:150] for outcome in outcomes if "error" in outcome)
    return [f"{number} times {text}" for text, number in errors.most_common(3)]
