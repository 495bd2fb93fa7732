"""`python -m benchmarks starts`: problems whose truth is right, outcomes that are kept, errors that are counted."""

import json

import pytest

from benchmarks.starts import command, methods, study, table
from benchmarks.starts.end import judge
from benchmarks.starts.problems import PROBLEMS, build_case

SLOW = ("tosses", "runs", "paper-reference", "friction")
NO_TIMES = {"seconds": 0, "fitting": 0, "optimizing": 0}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in sorted(PROBLEMS)]
)
def test_starts_are_feasible_and_differ_and_the_truth_is_right(name):
    case = build_case(name)
    for start in case.starts:
        assert case.problem.constraints.slack(case.problem.check_theta(start)).min() >= -1e-12
    assert len({start.tobytes() for start in case.starts}) == len(case.starts)
    fit = methods.fit_with()(case, case.near)
    found = judge(case.problem, fit.theta)
    best = found["cost"]
    assert case.excess(fit.said, best) == pytest.approx(0.0, abs=1e-6)
    assert case.is_best(**found, best=best)
    assert case.is_right(**found, best=best)
    # At a start nothing is right yet.
    for start in case.starts[:3]:
        there = judge(case.problem, start.tolist())
        assert not case.is_right(there["cost"], best, there["violation"])
    if case.noisy:
        assert best < case.cost_near
        assert not case.is_right(best + 2.5, best)


@pytest.fixture
def run(tmp_path, capsys):
    """The command on three starts of the two turns; returns what it printed and the file of outcomes."""

    def call(*arguments):
        command.main(["--folder", str(tmp_path), "--problems", "two-turns", "--starts", "3", *arguments])
        (path,) = tmp_path.glob("starts-*.jsonl")
        printed = capsys.readouterr()
        return printed.out, printed.err, path

    return call


def test_study_runs_and_goes_on(run):
    out, err, path = run("--methods", "exact")
    assert "| two-turns | exact |" in out
    assert "4 of 4 starts" in err  # the truth, and three
    lines = path.read_text().splitlines()
    # Killed in the middle of the last line: the start of this line is run again, and no other.
    path.write_text("\n".join(lines[:3]) + "\n" + lines[3][:20])
    assert "1 of 1 starts" in run("--methods", "exact")[1]
    kept = path.read_text().splitlines()
    assert [json.loads(line) | NO_TIMES for line in kept] == [json.loads(line) | NO_TIMES for line in lines]
    assert "4 of 4 starts" in run("--methods", "exact", "--fresh")[1]


def test_an_error_is_counted_and_ends_nothing(monkeypatch, run):
    def fail(case, start):
        if start[0] == case.starts[1][0]:
            raise FloatingPointError("made to fail")
        return methods.fit_with(max_iterations=1, strategy="local")(case, start)

    monkeypatch.setattr(study, "list_methods", lambda: {"exact": fail})
    out, _, path = run("--methods", "exact")
    outcomes = [json.loads(line) for line in path.read_text().splitlines()]
    assert [outcome.get("error") for outcome in outcomes] == [None, None, "FloatingPointError: made to fail", None]
    row = dict(zip(table.HEADER, [cell.strip() for cell in out.splitlines()[2].split("|")[1:-1]], strict=True))
    assert [row[name] for name in ("right", "errors", "wrong, claims success")] == ["0 of 3", "1", "0 of 2"]
    assert "1 times FloatingPointError: made to fail" in out
