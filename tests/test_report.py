"""The report as text and as figures, of fits made by hand and of one real one."""

from __future__ import annotations

import ast
import itertools
import re
from dataclasses import replace
from pathlib import Path
from string import Formatter

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from models import heated_room, temperature

import switchfit as sf
from switchfit.fit.result import Fit, Step, compute_scaled_spectrum
from switchfit.fit.termination import Kink, Termination
from switchfit.fit.trajectory import Comparison, Trajectory
from switchfit.optimize import IterationRecord, Status
from switchfit.problem.constraints import ActiveConstraint
from switchfit.report import sentences, verdict
from switchfit.report.numbers import format_rounded
from switchfit.report.plot import (
    choose_mode_colours,
    plot_comparison,
    plot_convergence,
    plot_fit,
    plot_modes,
    plot_residuals,
    plot_transitions,
)
from switchfit.report.style import MODE_COLOURS
from switchfit.report.text import report as write_report
from switchfit.runtime.issue import Issue
from switchfit.uncertainty.issues import find_issues


def trajectory_of(modes=("stick", "slip", "stick"), times=(0.0, 4.0, 7.0, 10.0), nodes=9) -> Trajectory:
    """States X (m) and dX (m/s) that jump at each transition."""
    t = [np.linspace(a, b, nodes) for a, b in itertools.pairwise(times)]
    states = np.concatenate([np.stack([np.sin(part) + i, np.cos(part)], axis=1) for i, part in enumerate(t)])
    labels = np.repeat(np.array(modes), nodes)
    segments = nodes * np.arange(len(modes) + 1)
    return Trajectory(np.concatenate(t), states, labels, segments, ("X", "dX"), ("m", "m/s"))


def comparison_of(trajectory: Trajectory, samples=30, kind="measurements", sigma=0.1, names=("X", "h")) -> Comparison:
    """Samples of both states, scattered by one sigma in turn up and down; the third sample of X is missing."""
    first, last = trajectory.times[0], trajectory.times[-1]
    times = np.linspace(first, last, samples) if kind == "measurements" else trajectory.times
    fitted = np.stack([np.interp(times, trajectory.times, x) for x in trajectory.states.T], axis=1)
    measured = fitted + 0.1 * (-1.0) ** np.arange(len(times))[:, None]
    if kind == "measurements":
        measured[2, 0] = np.nan
    spread = None if sigma is None else np.full(measured.shape, sigma)
    return Comparison(kind, names, times, measured, fitted, spread, trajectory.times, trajectory.states)


def made(**changes) -> Fit:
    """A fit of one experiment with two free transition times and one parameter; reduced chi-square 1."""
    trajectory = trajectory_of()
    theta = np.array([4.0, 7.0, 0.8])
    hessian = np.array([[400.0, 20.0, 0.0], [20.0, 100.0, 300.0], [0.0, 300.0, 2500.0]])
    fit = Fit(
        theta_names=("tau_1", "tau_2", "mu"),
        theta_units=("s", "s", "1"),
        initial_theta=np.array([3.0, 8.0, 0.5]),
        theta=theta,
        lower=np.array([-np.inf, -np.inf, 0.05]),
        upper=np.array([np.inf, np.inf, 2.0]),
        run_names=("run1",),
        transition_times=(theta[:2].copy(),),
        transition_places=(np.array([0, 1]),),
        parameters={"mu": np.array(0.8), "g": np.array(9.81)},
        parameter_units={"mu": "1", "g": "m/s^2"},
        fixed=("g",),
        cost=28.0,
        gradient=np.array([1e-9, -2e-9, 0.0]),
        hessian=hessian,
        optimality=2e-9,
        iterations=2,
        evaluations=4,
        status=Status.CONVERGED,
        history=tuple(
            IterationRecord(k, cost, optimality, 1.0, theta - k, k + 1)
            for k, (cost, optimality) in enumerate([(900.0, 50.0), (30.0, 1e-2), (28.0, 2e-9)])
        ),
        active=(),
        kinks=(),
        free_basis=np.eye(3),
        trajectories=(trajectory,),
        comparisons=((comparison_of(trajectory),),),
        sigma_known=True,
        integration_error=3e-11,
        hessian_kind="exact",
        tolerance=1e-7,
        seconds=1.25,
    )
    return replace(fit, **changes)


def several(count: int, names=None) -> Fit:
    """A fit of many experiments with two transitions each, the second one fixed, and one shared parameter."""
    names = names or [f"run{e + 1}" for e in range(count)]
    trajectories = tuple(trajectory_of(times=(0.0, 3.0 + 0.1 * e, 7.0, 10.0)) for e in range(count))
    theta = np.array([3.0 + 0.1 * e for e in range(count)] + [0.8])
    return made(
        theta_names=(*(f"{name}.tau_1" for name in names), "mu"),
        theta_units=("s",) * count + ("1",),
        initial_theta=theta - 0.5,
        theta=theta,
        lower=np.full(count + 1, -np.inf),
        upper=np.full(count + 1, np.inf),
        run_names=tuple(names),
        transition_times=tuple(np.array([3.0 + 0.1 * e, 7.0]) for e in range(count)),
        transition_places=tuple(np.array([e, -1]) for e in range(count)),
        gradient=np.zeros(count + 1),
        hessian=np.diag(np.linspace(100.0, 400.0, count + 1)),
        free_basis=np.eye(count + 1),
        trajectories=trajectories,
        comparisons=tuple((comparison_of(t, names=("X", "dX")),) for t in trajectories),
        cost=29.0 * count,
        history=tuple(IterationRecord(k, 900.0 / (k + 1), 10.0**-k, 1.0, theta, k + 1) for k in range(3)),
    )


def report(fit: Fit) -> str:
    """All of it; `test_verdict.py` has tests of the report of one screen."""
    return write_report(fit, full=True)


def line_with(text: str, start: str) -> str:
    """The only line that begins with `start`, spaces aside, with single spaces."""
    found = [line for line in text.splitlines() if line.strip().startswith(start)]
    assert len(found) == 1, f"{start!r} begins {len(found)} lines of\n{text}"
    return " ".join(found[0].split())


# --- text -------------------------------------------------------------------------------------------------------------


def test_report_of_a_good_fit():
    text = report(made())
    assert line_with(text, "experiment") == "experiment stick -> slip -> stick, 0 to 10 s"
    assert line_with(text, "X, h") == "X, h: 30 samples, 1 of 60 values missing"
    assert line_with(text, "method") == "method SQP with the exact Hessian and a line search"
    assert line_with(text, "effort") == "effort 2 iterations, 4 evaluations, 1.25 s"
    assert line_with(text, "status") == "status Converged: the optimality 2.0e-09 is below the tolerance 1.0e-07."
    assert line_with(text, "cost J") == "cost J 28 (first guess: 900)"
    assert line_with(text, "reduced chi-square").startswith("reduced chi-square 1 (2 J / (59 values - 3 free unknowns)")
    assert line_with(text, "X  ") == "X 29 0.1 m 1 99.12 %"
    assert line_with(text, "h  ") == "h 30 0.1 1 98.1 %"  # no state is called h: no unit
    assert text.splitlines()[0].startswith("Good: converged; one fit; the model explains ")
    assert "Warnings" not in text
    assert all(len(line) <= 100 and line == line.rstrip() for line in text.splitlines())


def test_unknowns_have_errors_units_guesses_and_modes():
    fit = made()
    text = report(fit)
    # (H^-1)_ii by hand: det = 400 (250000 - 90000) - 20 (20 * 2500) = 63e6
    by_hand = np.sqrt([160000 / 63e6, 1e6 / 63e6, (40000 - 400) / 63e6])
    assert fit.standard_errors == pytest.approx(by_hand)
    assert line_with(text, "tau_1  ") == "tau_1 4.000 ± 0.050 (1.3 %) s 3 stick -> slip"
    assert line_with(text, "tau_2  ") == "tau_2 7.00 ± 0.13 (1.8 %) s 8 slip -> stick"
    assert line_with(text, "mu  ") == "mu 0.800 ± 0.025 (3.1 %) 0.5"
    assert line_with(text, "g  ") == "g 9.81 m/s^2"
    # correlation of tau_2 and mu: -cofactor / root of the product of the others
    assert line_with(text, "tau_2, mu") == f"tau_2, mu {-400 * 300 / np.sqrt(1e6 * 39600):+.3f}"


@pytest.mark.parametrize(
    ("value", "error", "expected"),
    [
        (43.0162288, 0.1215, ("43.02", "± 0.12", "(0.28 %)")),
        (0.02003193, 0.000110893, ("0.02003", "± 0.00011", "(0.55 %)")),
        (-123456.7, 2345.6, ("-123457", "± 2346", "(1.9 %)")),
        (1.23456789e-7, 2.34e-11, ("1.23457e-07", "± 2.3e-11", "(0.019 %)")),
        (5.4321e9, 1.2e6, ("5.4321e+09", "± 1.2e+06", "(0.022 %)")),
        (0.0, 0.5, ("0.00", "± 0.50", "")),
        (3.14159265358979, np.nan, ("3.1415927", "", "")),
        (2.0, 0.0, ("2", "held", "")),
    ],
)
def test_values_are_rounded_to_their_errors(value, error, expected):
    assert format_rounded(value, error) == expected


def test_after_strategies_the_first_guess_is_that_of_the_user():
    steps = (Step("local", 120.0, 40, 0.5), Step("many starts", 28.0, 300, 2.0, "settled"))
    fit = made(steps=steps, starts=(23, 0, 5), initial_cost=15087.7, evaluations=340)
    text = report(fit)
    assert line_with(text, "effort") == "effort 340 evaluations, 1.25 s in all, 2 iterations in the last fit"
    assert line_with(text, "cost J") == "cost J 28 (first guess: 15087.7)"
    assert line_with(text, "tried") == "tried local: J = 120 (0.5 s); many starts: J = 28 (2 s)"
    found = "starts the lowest J was found from 5 of 23 other starts; no further minimum is likely"
    assert line_with(text, "starts") == found
    for ended, words in {"time": "ended by the limit of time", "most": "there may be further minima"}.items():
        again = made(steps=(steps[0], replace(steps[1], ended=ended)), starts=(23, 0, 5), initial_cost=15087.7)
        assert f"5 of 23 other starts; {words}" in line_with(report(again), "starts")


def test_a_first_guess_that_cannot_be_integrated_has_no_cost():
    fit = made(steps=(Step("local", np.inf, 0, 0.1), Step("beam along the log", 28.0, 300, 2.0)))
    assert line_with(report(fit), "cost J") == "cost J 28 (first guess: not integrable)"
    assert line_with(report(fit), "tried") == "tried local: failed (0.1 s); beam along the log: J = 28 (2 s)"


def test_what_failed_is_said_first():
    statuses = {
        Status.MAX_ITERATIONS: "not converged: stopped at iteration 2; one fit: raise max_iterations, or strategy=",
        Status.LINE_SEARCH_FAILED: "not converged: the line search failed (optimality 2.0e-09); one fit: strategy=",
        Status.INTERRUPTED: "not converged: interrupted at iteration 2; one fit: continue with start=estimate.theta.",
        Status.NONFINITE_START: "not started: the cost or a derivative is not finite at the first guess; one fit: sta",
        Status.SADDLE: "not a minimum but a saddle point; one fit: strategy=",
        Status.ERROR: "the fit ended with an error; one fit: strategy=",
        Status.INFEASIBLE: "a guard or terminal constraint is not met; one fit: start nearer to a point that meets",
    }
    doubted = {
        Status.SINGULAR: "; the data hardly determine tau_2 and mu: fix one of them or add data.",
        Status.COLLAPSED: "; the cost does not depend on tau_2: strategy='thorough', or leave the mode out",
    }
    for status in Status:
        idle = ("tau_2",) if status is Status.COLLAPSED else ()
        first = " ".join(report(made(status=status, idle=idle)).split("\n\n")[0].split())
        if status in statuses:
            assert first.startswith(f"Bad: {statuses[status]}"), first
        else:
            assert first.startswith("Doubtful: converged; " if status in doubted else "Good: converged; "), first
            assert doubted.get(status, "") in first


def test_the_verdict_says_where_a_line_search_failed():
    begins = "Bad: not converged: the line search failed (optimality 2.0e-09) "
    for kind, subjects, figures, words in (
        (
            "jump",
            ("mu", "tau_1"),
            {"at": (0.3, 2.0)},
            "where the cost jumps, at mu = 0.3, tau_1 = 2; one fit: strategy=",
        ),
        ("kink", ("mu",), {"at": (0.3,)}, "where the slope of the cost jumps, at mu = 0.3; one fit: strategy="),
        ("wrong slope", ("mu",), {}, "since the derivatives do not belong to the cost; one fit: run sf.check_deriv"),
        ("rounding", (), {}, "since what the cost can still fall is less than its rounding error; one fit: ask for a"),
        ("valley", (), {}, "in a narrow valley of the cost; one fit: strategy="),
        (
            "switch",
            ("mu", "mode 'm' compares with mu at own.py:3"),
            {"at": 0.3},
            "where the cost jumps, at mu = 0.3; one fit; mode 'm' compares with mu at own.py:3, which derivatives do "
            "not include: make mu a transition time if it is one, or use a smooth function.",
        ),
    ):
        fit = made(status=Status.LINE_SEARCH_FAILED, reason=Issue(kind, subjects, figures))
        assert " ".join(report(fit).split()).startswith(begins + words)


MESSAGES = [
    (
        Termination(Status.CONVERGED_AT_KINK, kinks=(Kink("tau_1", 0.5, -0.7, 0.3),)),
        "Converged at a kink of the cost: tau_1 = 0.5, where the derivative jumps from -7.0e-01 to 3.0e-01. The",
    ),
    (
        Termination(Status.MAX_ITERATIONS, iterations=12, earlier_iterations=9, optimality=0.5, tolerance=1e-7),
        "Stopped after 12 iterations, 9 of them before the mesh was refined, with optimality 5.0e-01 above the "
        "tolerance 1.0e-07. Raise max_iterations",
    ),
    (Termination(Status.SADDLE, smallest_eigenvalue=-1.0), "has the eigenvalue -1.0e+00, and no step along it"),
    (
        Termination(Status.SINGULAR, flat_direction=(("a", 0.71), ("b", -0.7)), smallest_eigenvalue=1e-14),
        "flat to second order along +0.71 a -0.7 b (scaled eigenvalue 1.0e-14): these unknowns are not identified.",
    ),
    (Termination(Status.COLLAPSED, idle=("tau_1", "leak")), "nor on what acts in it alone (tau_1, leak). Leave it"),
    (
        Termination(Status.INFEASIBLE, violated=(("terminal constraint 1", 1.5), ("terminal constraint 2", -2.0))),
        "The constraints are not met: terminal constraint 1 = 1.50e+00; terminal constraint 2 = -2.00e+00. Start",
    ),
    (Termination(Status.INTERRUPTED, iterations=3), "Interrupted after 3 iterations with"),
    (Termination(Status.NONFINITE_START), "not finite at the starting point"),
    (Termination.of_error("KeyError: 3."), "The fit ended with an error, and was left where it was. KeyError: 3."),
    (
        Termination(Status.CONVERGED, active=(ActiveConstraint("lower bound", 0.05, "mu"),)),
        ". Active: mu at its lower bound 0.05.",
    ),
]


@pytest.mark.parametrize(("ended", "words"), MESSAGES, ids=[ended.status.name for ended, _ in MESSAGES])
def test_messages(ended, words):
    assert words in str(ended)


@pytest.mark.parametrize(
    ("reason", "words"),
    [
        (
            Issue("wrong slope", ("k",), {"before": -4.0, "after": 4.0, "derivatives": (-2.0,), "differences": (2.0,)}),
            "along that direction it says -4, differences of the cost say 4; it is wrong in k (derivative -2, "
            "differences 2). Check the derivatives.",
        ),
        (
            Issue("jump", ("k",), {"before": 0.49, "after": 2.49, "at": (0.3,)}),
            "The cost jumps from 0.49 to 2.49 where k passes 0.3. The optimiser needs",
        ),
        (
            Issue("jump", ("k", "c"), {"before": 0.49, "after": 2.49, "at": (0.3, 1.0)}),
            "where the step passes k = 0.3, c = 1. The optimiser needs",
        ),
        (
            Issue("switch", ("k", "mode 'm' compares with k at own.py:3"), {"before": 1.0, "after": 2.0, "at": 0.3}),
            "The cost jumps from 1 to 2 where k passes 0.3: mode 'm' compares with k at own.py:3, and derivatives do",
        ),
        (
            Issue("kink", ("k",), {"before": -1.0, "after": 3.0, "at": (0.3,)}),
            "but there is a kink close by, near k = 0.3: along that direction the slope jumps from -1 to 3.",
        ),
        (Issue("rounding", (), {"noise": 1e-3}), "is less than its rounding error, 1.0e-03. Scale the unknowns"),
        (Issue("valley", (), {"condition": 1e9}), "(condition number of the scaled Hessian 1.0e+09). Start elsewhere"),
        (Issue("valley", (), {"condition": 1e9, "delayed": 1.0}), "'gauss-newton'. A delay is estimated here: J has"),
    ],
)
def test_reasons_of_a_line_search_that_failed(reason, words):
    text = str(Termination(Status.LINE_SEARCH_FAILED, reason=reason))
    assert text.startswith("The line search found no decrease of the cost along a descent direction (optimality ")
    assert words in text
    assert ("Check the derivatives" in text) == (reason.kind == "wrong slope")


def test_every_status_has_a_message():
    for status in Status:
        assert len(str(Termination(status))) > 40


def test_long_messages_are_wrapped():
    text = report(made(status=Status.ERROR, reason=Issue("error", ("word " * 60,))))
    assert max(len(line) for line in text.splitlines()) <= 100
    assert text.count("word") == 60


def test_sigma_unknown_is_estimated_from_the_residuals():
    text = report(made(sigma_known=False, cost=0.28))
    assert line_with(text, "residual variance") == (
        "residual variance 0.01 (2 J / (59 values - 3 free unknowns), so sigma is about 0.1)"
    )
    assert "± 0.0050" in line_with(text, "tau_1  ")
    assert "Warnings" not in text


def test_reference_signals_have_no_errors_and_say_why():
    trajectory = trajectory_of()
    fit = made(sigma_known=None, comparisons=((comparison_of(trajectory, kind="reference", sigma=None),),))
    text = report(fit)
    assert line_with(text, "X, h") == "X, h: reference signal"
    assert line_with(text, "X  ") == "X signal 0.1 m 99.12 %"
    assert line_with(text, "tau_1  ") == "tau_1 4 s 3 stick -> slip"
    assert "std. error" not in text
    assert "Correlations" not in text
    assert "chi-square" not in text
    assert [w for w in warnings_of(fit) if w.startswith("No standard errors: the cost has no noise model")]


def test_a_cost_without_data():
    text = report(made(sigma_known=None, comparisons=((),)))
    assert line_with(text, "no data") == "no data: a cost of the trajectory"
    assert "rmse" not in text


def test_a_channel_without_a_single_value():
    trajectory = trajectory_of()
    comparison = comparison_of(trajectory)
    comparison.measured[:, 0] = np.nan
    assert line_with(report(made(comparisons=((comparison,),))), "X  ") == "X 0 m"


def warnings_of(fit: Fit) -> list[str]:
    return [str(issue) for issue in find_issues(fit)]


def only_warning(fit: Fit) -> str:
    warnings = warnings_of(fit)
    assert len(warnings) == 1, warnings
    first = report(fit).split("Warnings\n  - ")[1].split()[0]
    assert warnings[0].startswith(first)
    return warnings[0]


def bound(kind, value=0.8, name="mu") -> dict:
    return {"active": (ActiveConstraint(kind, value, name),), "free_basis": np.eye(3)[:, :2], "cost": 28.5}


def mode_held(kind, value, mode="slip", **where) -> dict:
    return {"active": (ActiveConstraint(kind, value, mode=mode, position=1, **where),)}


def few_values() -> Comparison:
    comparison = comparison_of(trajectory_of(), samples=3, sigma=None)
    return replace(comparison, measured=comparison.fitted * [np.nan, 1.0])


NOTHING = {
    "status": Status.NONFINITE_START, "cost": np.nan, "gradient": np.full(3, np.nan),
    "hessian": np.full((3, 3), np.nan), "optimality": np.nan, "history": (), "free_basis": np.zeros((3, 0)),
}  # fmt: skip
KINKS = Kink("tau_1", 4.0, -3.0, 5.0), Kink("tau_2", 7.0, -1.0, 1.0)
WARNINGS = [
    (bound("upper bound"), "mu is at its upper bound 0.8: it has no standard error", "mu 0.8 held 0.5 AT UPPER BOUND"),
    (bound("lower bound"), "mu is at its lower bound 0.8: it has no standard error", "mu 0.8 held 0.5 AT LOWER BOUND"),
    (mode_held("collapsed", 0.0), "Mode 2 ('slip') has collapsed to nothing: the data want no such mode there.", ""),
    (
        mode_held("minimum duration", 0.5, run="run1"),
        "Mode 2 ('slip') of run1 is at its minimum duration: the data would have it",
        "",
    ),
    (
        {"kinks": KINKS[:1], "free_basis": np.eye(3)[:, 1:], "cost": 28.5},
        "tau_1 is at a kink of the cost, as where a transition meets a sample. It has no",
        "tau_1 4 held s 3 stick -> slip, AT A KINK",
    ),
    (
        {"kinks": KINKS, "free_basis": np.eye(3)[:, 2:], "cost": 29.0},
        "tau_1, tau_2 are at kinks of the cost, as where a transition meets a sample.",
        "",
    ),
    (
        {"hessian": np.diag([1.0, -4.0, 1.0]), "status": Status.SADDLE},
        "No standard errors of tau_2: the Hessian is not positive definite (smallest eigenvalue -1, scaled",
        "",
    ),
    (
        {"sigma_known": False, "comparisons": ((few_values(),),)},
        "No standard errors: sigma is unknown and 3 values are too few to estimate it beside 3 unknowns.",
        "",
    ),
    (NOTHING, "No standard errors: the cost or its derivatives are not finite.", "tau_1 4 s 3 stick -> slip"),
    ({"integration_error": 3e-5}, "The integration error of J is 3.0e-05", ""),
    ({"integration_error": np.nan}, "The integration error of J is nan", ""),
]


@pytest.mark.parametrize(("changes", "warning", "row"), WARNINGS, ids=[warning[:40] for _, warning, _ in WARNINGS])
def test_warnings_and_the_row_of_the_unknown(changes, warning, row):
    fit = made(**changes)
    assert only_warning(fit).startswith(warning)
    assert not row or line_with(report(fit), f"{row.split()[0]}  ") == row


def test_a_parameter_is_no_transition_time_whatever_it_is_called():
    """It is higher or lower, not later or earlier; idle, it acts in collapsed modes alone."""
    a, b = np.array([0.0, 3.0, 500.0]), np.array([1.0, 0.0, 0.0])
    hessian = np.outer(a, a) + np.outer(b, b) + np.diag([0.0, 1e-3, 0.0])
    changes = {
        "theta_names": ("tau_1", "tau_2", "tau_heat"), "parameters": {"tau_heat": np.array(0.8)},
        "parameter_units": {"tau_heat": ""}, "fixed": (),
    }  # fmt: skip
    said = " ".join(report(made(**changes, hessian=hessian)).split())
    assert re.search(r"tau_heat and tau_2 trade off [^:]*: tau_heat \S+ higher and tau_2 \S+ s earlier,", said), said
    (warning,) = [text for text in warnings_of(made(**changes, idle=("tau_heat",))) if "collapsed" in text]
    assert warning.startswith("tau_heat: acts only in modes that have collapsed.")


@pytest.mark.parametrize("rounding", [-9.6e-18, 2.2e-16, 0.0])
def test_an_eigenvalue_of_the_size_of_rounding_is_zero(rounding):
    known = np.array([3.0, 5.0]) / np.hypot(3.0, 5.0)
    other = np.array([-known[1], known[0]])
    spectrum = compute_scaled_spectrum(np.outer(known, known) + rounding * np.outer(other, other), np.eye(2))
    assert spectrum.values[0] == 0.0
    assert spectrum.values[1] == pytest.approx(2.0)  # of a Hessian with a diagonal of one


def test_warning_of_unknowns_that_are_not_told_apart():
    a, b = np.array([0.0, 3.0, 500.0]), np.array([1.0, 0.0, 0.0])
    fit = made(hessian=np.outer(a, a) + np.outer(b, b), status=Status.SINGULAR)
    undetermined, without = warnings_of(fit)
    assert undetermined.startswith("The data hardly determine tau_2 and mu apart from one another")
    assert "(smallest eigenvalue 0 of" in undetermined
    assert without.startswith("No standard errors of tau_2 and mu: the Hessian is not positive definite")
    nearly = made(hessian=np.outer(a, a) + np.outer(b, b) + np.diag([0.0, 1e-7, 0.0]))
    assert only_warning(nearly).startswith("The data hardly determine tau_2 and mu apart from one another")
    single = warnings_of(made(hessian=np.diag([1.0, 0.0, 1.0]), status=Status.SINGULAR))
    assert single[0].startswith("The data hardly determine tau_2 (smallest eigenvalue 0 of")


@pytest.mark.parametrize(
    ("cost", "words"),
    [
        (4 * 28.0, ("is 4 where 1 is expected: sigma is too small", "too small, by a factor of 2 ")),
        (28.0 / 4, ("is 0.25 where 1 is expected: sigma is too large", "too large, by a factor of 2 ")),
    ],
)
def test_warning_of_a_wrong_sigma(cost, words):
    warning = only_warning(made(cost=cost))
    assert all(part in warning for part in words)
    assert not warnings_of(made(cost=cost, sigma_known=False))
    assert not warnings_of(made(cost=cost, status=Status.MAX_ITERATIONS))
    assert not warnings_of(made(cost=28.0 * 1.3)), "chance explains it"


def test_no_trend_where_the_data_is_met_exactly():
    comparison = comparison_of(trajectory_of(), sigma=None)
    exact = replace(comparison, measured=comparison.fitted)
    assert not warnings_of(made(comparisons=((exact,),), cost=0.0, sigma_known=False))


# --- several experiments ----------------------------------------------------------------------------------------------


def test_transitions_have_their_places_in_theta():
    fit = several(2, names=["dry", "wet"])
    assert [(t.run, t.name, t.index, t.before, t.after) for t in fit.transitions] == [
        ("dry", "dry.tau_1", 0, "stick", "slip"),
        ("dry", "dry.tau_2", None, "slip", "stick"),
        ("wet", "wet.tau_1", 1, "stick", "slip"),
        ("wet", "wet.tau_2", None, "slip", "stick"),
    ]
    text = report(fit)
    assert line_with(text, "dry  ") == "dry stick -> slip -> stick, 0 to 10 s"
    assert line_with(text, "wet.tau_2") == "wet.tau_2 7 s slip -> stick"
    assert line_with(text, "wet dX") == "wet dX 30 0.1 m/s 1 98.1 %"


def test_transitions_of_one_experiment_with_the_first_fixed():
    fit = made(
        theta_names=("tau_2", "tau_1"), transition_places=(np.array([-1, 0]),), theta_units=("s", ""),
        theta=np.array([7.0, 4.0]), initial_theta=np.ones(2), hessian=np.eye(2), free_basis=np.eye(2),
    )  # fmt: skip
    assert [(t.name, t.index) for t in fit.transitions] == [("tau_1", None), ("tau_2", 0)]


def test_transition_times_are_listed_where_parameters_are_many():
    d = 2 + 14
    names = ("tau_1", "tau_2", *(f"level_{k}" for k in range(14)))
    theta = np.array([4.0, 7.0, *np.linspace(0.5, 0.9, 14)])
    fit = made(
        theta_names=names, theta_units=("s", "s", *[""] * 14), initial_theta=theta - 0.1, theta=theta,
        lower=np.full(d, -np.inf), upper=np.full(d, np.inf), hessian=np.diag(np.linspace(100.0, 400.0, d)),
        gradient=np.zeros(d), free_basis=np.eye(d), parameters={name: np.array(0.5) for name in names[2:]},
        parameter_units={}, fixed=(),
    )  # fmt: skip
    text = write_report(fit)
    assert "more unknowns" in text
    assert line_with(text, "tau_1").startswith("tau_1 4.00 ")
    assert line_with(text, "tau_2").startswith("tau_2 7.000 ")
    assert "level_13" not in text


def test_many_experiments_are_cut_short_unless_all_is_asked_for():
    fit = several(14)
    text = write_report(fit)
    assert "and 11 more experiments" in text
    assert (
        line_with(text, "run3  ") == "run3 stick -> slip -> stick, 0 to 10 s; X, dX: 30 samples, 1 of 60 values missing"
    )
    assert "run4  " not in text
    assert line_with(text, "mu  ").startswith("mu 0.8")  # what the runs share
    assert "and 7 more unknowns" in text
    assert "and 24 more channels" in text
    assert "run14.tau_1" not in text
    whole = report(fit)
    assert all(f"run{e + 1}  " in whole for e in range(14))
    assert "run14.tau_1" in whole
    assert "more" not in whole


def test_correlations_are_the_largest_first():
    d = 8
    rng = np.random.default_rng(0)
    factor = rng.standard_normal((d, d))
    names = tuple(f"p{k}" for k in range(d))
    fit = made(
        theta_names=names, theta_units=("",) * d, theta=np.arange(d) + 1.0, initial_theta=np.ones(d),
        lower=np.full(d, -np.inf), upper=np.full(d, np.inf), hessian=factor @ factor.T, free_basis=np.eye(d),
        parameters={name: np.array(1.0) for name in names}, fixed=(), transition_places=(np.array([-1, -1]),),
    )  # fmt: skip
    section = report(fit).split("Correlations above 0.1\n")[1].split("\n\n")[0].splitlines()
    sizes = [abs(float(line.split()[-1])) for line in section]
    expected = np.sort(np.abs(fit.correlation[np.tril_indices(d, -1)]))[::-1]
    expected = expected[expected > 0.1]
    assert sizes == pytest.approx(expected, abs=6e-4)
    (line,) = write_report(fit).split("Correlations above 0.1\n")[1].split("\n\n")[0].splitlines()
    *shown, rest = line.split("; ")
    assert [abs(float(part.split()[-1])) for part in shown] == pytest.approx(expected[:3], abs=6e-4)
    assert rest == f"and {len(expected) - 3} more"


def test_array_parameters_that_are_fixed_are_abbreviated():
    parameters, units = {"mu": np.array(0.8), "table": np.arange(100.0)}, {"mu": "1", "table": "K"}
    text = report(made(parameters=parameters, parameter_units=units, fixed=("table",)))
    assert line_with(text, "table") == "table [0, 1, ..., 98, 99] K"


# --- figures ----------------------------------------------------------------------------------------------------------


def axes() -> tuple[Figure, object]:
    figure = Figure(figsize=(8, 3))
    return figure, figure.add_subplot()


def test_figure_of_a_fit():
    fit = made()
    figure = plot_fit(fit)
    assert [ax.get_ylabel() for ax in figure.axes] == ["X (m)", "residual\n(m)", "h", "residual"]
    assert [ax.get_xlabel() for ax in figure.axes] == ["", "", "", "time (s)"]
    assert all(ax.get_xlim() == (0.0, 10.0) for ax in figure.axes)
    assert [text.get_text() for text in figure.axes[0].texts] == ["stick", "slip", "stick"]
    assert not figure.axes[1].texts
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ["measured", "fitted", "± sigma", "transition", "transition, 95 % interval"]
    figure.draw_without_rendering()


def test_comparison_draws_samples_and_curve():
    trajectory = trajectory_of()
    comparison = comparison_of(trajectory)
    _, ax = axes()
    assert plot_comparison(comparison, trajectory, 0, ax) is ax
    samples, curve = ax.lines
    np.testing.assert_array_equal(samples.get_ydata(), comparison.measured[:, 0])
    assert (samples.get_linestyle(), samples.get_marker()) == ("None", "o")
    assert curve.get_linestyle() == "-"
    x, y = curve.get_data()
    assert x[np.isnan(y)].tolist() == [4.0, 7.0]  # states jump there
    np.testing.assert_array_equal(y[~np.isnan(y)], comparison.curve[:, 0])


def test_reference_signals_are_dashed_and_grey():
    trajectory = trajectory_of()
    _, ax = axes()
    plot_comparison(comparison_of(trajectory, kind="reference", sigma=None), trajectory, 0, ax)
    signal, _ = ax.lines
    assert signal.get_linestyle() == "--"
    assert len(set(to_rgb(signal.get_color()))) == 1


def test_residuals_lie_between_sigmas():
    trajectory = trajectory_of()
    comparison = comparison_of(trajectory)
    _, ax = axes()
    assert plot_residuals(comparison, trajectory, 0, ax) is ax
    _, residuals, upper, lower = ax.lines
    np.testing.assert_array_equal(residuals.get_ydata(), comparison.residuals[:, 0])
    assert set(upper.get_ydata()) == {0.1}
    assert set(lower.get_ydata()) == {-0.1}
    _, ax = axes()
    plot_residuals(replace(comparison, sigma=None), trajectory, 0, ax)
    assert len(ax.lines) == 2


def spans(ax) -> list[tuple[float, float]]:
    return [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in ax.patches]


def test_modes_are_shaded_and_named():
    _, ax = axes()
    assert plot_modes(trajectory_of(), ax) is ax
    assert spans(ax) == [(0.0, 4.0), (4.0, 7.0), (7.0, 10.0)]
    stick, slip, again = (patch.get_facecolor() for patch in ax.patches)
    assert stick == again != slip
    assert [text.get_text() for text in ax.texts] == ["stick", "slip", "stick"]
    assert [text.get_rotation() for text in ax.texts] == [0, 0, 0]


def test_names_of_short_modes_are_turned_or_left_out():
    _, ax = axes()
    modes = ("before", "impact", "gone", "collapsed", "after")
    plot_modes(trajectory_of(modes, (0.0, 4.0, 4.4, 4.41, 4.41, 10.0)), ax)
    assert [(text.get_text(), text.get_rotation()) for text in ax.texts] == [
        ("before", 0),
        ("impact", 90),
        ("after", 0),
    ]
    assert len(ax.patches) == 4


def test_modes_too_short_for_a_name_are_in_the_legend():
    trajectory = trajectory_of(("a", "b", "collapsed", "c"), (0.0, 4.0, 4.01, 4.01, 10.0))
    times = np.array([4.0, 4.01, 4.01])
    fit = made(
        trajectories=(trajectory,),
        comparisons=((),),
        transition_times=(times,),
        transition_places=(np.array([0, 1, -1]),),
        sigma_known=None,
    )
    assert [text.get_text() for text in plot_fit(fit).legends[0].get_texts()] == ["fitted", "transition", "b"]


def test_mode_colours_are_light_and_differ_in_grey():
    grey = np.array([np.dot([0.2126, 0.7152, 0.0722], to_rgb(colour)) for colour in MODE_COLOURS])
    assert grey.min() > 0.75
    assert np.abs(np.diff(grey)).min() > 0.02
    colours = choose_mode_colours(
        [trajectory_of(("a", "b"), (0.0, 1.0, 2.0)), trajectory_of(("c", "b"), (0.0, 1.0, 2.0))]
    )
    assert list(colours) == ["a", "b", "c"]
    assert len(set(colours.values())) == 3


def test_transitions_have_bands_of_their_intervals():
    _, ax = axes()
    assert plot_transitions([4.0, 7.0, 9.0], [[3.5, 4.75], [np.nan, np.nan], [9.0, 9.0]], ax) is ax
    assert [line.get_xdata()[0] for line in ax.lines] == [4.0, 7.0, 9.0]
    assert spans(ax) == [(3.5, 4.75)]


def test_bands_in_a_figure_are_the_intervals():
    fit = made()
    bands = spans(plot_fit(fit, level=0.9).axes[0])[3:]
    half = scipy.stats.norm.ppf(0.95) * fit.standard_errors[:2]
    np.testing.assert_allclose(bands, np.stack([fit.theta[:2] - half, fit.theta[:2] + half], axis=1), rtol=1e-12)
    without = plot_fit(made(sigma_known=None))
    assert len(spans(without.axes[0])) == 3
    assert "transition, 95 % interval" not in [text.get_text() for text in without.legends[0].get_texts()]


def test_convergence_is_logarithmic():
    figure, ax = axes()
    history = [IterationRecord(k, 1.0, value, 1.0, np.zeros(1), k) for k, value in enumerate([50.0, 1e-2, 0.0])]
    assert plot_convergence(history, ax, tolerance=1e-7) is ax
    assert ax.get_yscale() == "log"
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("iteration", "optimality (KKT residual)")
    np.testing.assert_array_equal(ax.lines[0].get_ydata(), [50.0, 1e-2, np.nan])
    assert ax.lines[1].get_ydata()[0] == 1e-7
    figure.draw_without_rendering()


def test_states_are_drawn_where_there_is_no_data():
    figure = plot_fit(made(sigma_known=None, comparisons=((),)))
    assert [ax.get_ylabel() for ax in figure.axes] == ["X (m)", "dX (m/s)"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["fitted", "transition"]
    figure.draw_without_rendering()


def titles(figure) -> list[str]:
    return [block.get_suptitle() for block in figure.subfigs]


def test_each_experiment_has_its_own_column():
    figure = plot_fit(several(2, names=["dry", "wet"]))
    assert titles(figure) == ["dry", "wet"]
    assert len(figure.axes) == 2 * 4
    assert figure.get_suptitle() == ""


def test_a_fit_that_failed_says_so_in_its_figure():
    figure = plot_fit(made(status=Status.MAX_ITERATIONS))
    assert figure.legends[0].get_title().get_text() == "Not a minimum: max iterations"


# --- a real fit -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def heater() -> sf.Estimate:
    """A heater goes off at 4 s; sigma is 0.05."""
    times = np.linspace(0.1, 9.9, 41)
    values = temperature(times, 4.0, 2.0, 0.3, start=0.0) + 0.05 * np.random.default_rng(3).standard_normal(41)
    run = sf.Experiment(
        sf.Measurements(times, values, observe=lambda t, x, p: jnp.array([x[0]]), sigma=0.05, names=("T",)),
        ("on", "off"), (5.0,), 0.0, 10.0,
    )  # fmt: skip
    parameters = {"power": sf.Parameter(1.5, lower=0.0, unit="K/s"), "k": sf.Parameter(0.3, fixed=True)}
    return sf.estimate(sf.Problem(heated_room(0.0), run, parameters))


def test_what_is_held_fixed_is_printed_as_a_number():
    fixed = {"k": sf.Parameter(21.0, fixed=True), "gains": sf.Parameter([1.0, -0.25, 1e-12], fixed=True)}
    system = sf.HybridSystem({"m": lambda t, x, p: p["a"] - p["k"] * x * p["gains"][1] * 0.0}, [0.0])
    data = sf.Measurements(np.arange(5.0), [0.1, 1.0, 1.9, 3.0, 4.1], sigma=0.1)
    fit = sf.estimate(sf.Problem(system, sf.Experiment(data, ["m"], []), {"a": 0.5, **fixed}), strategy="local")
    assert re.search(r"\n  k +21\n  gains +\[1, -0\.25, 1e-12\]\n", str(fit))


# --- sentences --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("module", [sentences, verdict])
def test_fields_of_sentences_are_words_or_figures(module):
    """A field of another name would be written as nan."""
    library = Path(sf.__file__).parent
    sources = (path for path in library.rglob("*.py") if "report" not in path.parts)
    nodes = itertools.chain.from_iterable(ast.walk(ast.parse(path.read_text())) for path in sources)
    known = {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    table = module._ISSUES if module is sentences else module._REASONS
    templates = [text for text in table.values() if isinstance(text, str)]
    fields = {field for text in templates for _, field, *_ in Formatter().parse(text) if field}
    assert len(fields) > 10
    assert {field for field in fields if not field.isdigit()} <= module._WORDS.keys() | known
