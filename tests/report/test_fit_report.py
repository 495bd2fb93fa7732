"""The report as text and as figures, of fits made by hand and of one real one."""

import ast
import itertools
from dataclasses import replace
from functools import cache
from pathlib import Path
from string import Formatter

import numpy as np
import pytest
import scipy.stats
from matplotlib.figure import Figure

import switchfit as sf
from support.fits_by_hand import NOTHING, comparison_of, made, several, trajectory_of, warnings_of, write_report
from support.places import SAVED
from switchfit.fit.result import Fit
from switchfit.fit.scaled_hessian import compute_scaled_spectrum
from switchfit.fit.search_record import Step
from switchfit.fit.termination import Kink, Termination
from switchfit.optimize import Status
from switchfit.problem.constraints import ActiveConstraint
from switchfit.report import issues, verdict
from switchfit.report import templates as templates_module
from switchfit.report.fit_figure import plot_fit
from switchfit.report.numbers import format_rounded
from switchfit.report.panels import plot_comparison, plot_modes, plot_residuals
from switchfit.runtime.issue import Issue


def report(fit: Fit) -> str:
    """All of it; `test_verdict.py` has tests of the report of one screen."""
    return write_report(fit, full=True)


# --- text -------------------------------------------------------------------------------------------------------------


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


def bound(kind) -> dict:
    return {"active": (ActiveConstraint(kind, 0.8, "mu"),), "free_basis": np.eye(3)[:, :2], "cost": 28.5}


def mode_held(kind, value, mode="slip", **where) -> dict:
    return {"active": (ActiveConstraint(kind, value, mode=mode, position=1, **where),)}


KINKS = Kink("tau_1", 4.0, -3.0, 5.0), Kink("tau_2", 7.0, -1.0, 1.0)


def correlated(extra: float) -> dict:
    """A Hessian that cannot tell tau_2 and mu apart, but for a small curvature along tau_2."""
    a, b = np.array([0.0, 3.0, 500.0]), np.array([1.0, 0.0, 0.0])
    return {"hessian": np.outer(a, a) + np.outer(b, b) + np.diag([0.0, extra, 0.0])}


def many_unknowns() -> Fit:
    d = 2 + 14
    names = ("tau_1", "tau_2", *(f"level_{k}" for k in range(14)))
    theta = np.array([4.0, 7.0, *np.linspace(0.5, 0.9, 14)])
    return made(
        theta_names=names, theta_units=("s", "s", *[""] * 14), initial_theta=theta - 0.1, theta=theta,
        lower=np.full(d, -np.inf), upper=np.full(d, np.inf), hessian=np.diag(np.linspace(100.0, 400.0, d)),
        gradient=np.zeros(d), free_basis=np.eye(d), parameters={name: np.array(0.5) for name in names[2:]},
        parameter_units={}, fixed=(),
    )  # fmt: skip


FEW, WITHOUT = comparison_of(trajectory_of(), samples=3, sigma=None), comparison_of(trajectory_of())
FEW.measured[:] = FEW.fitted * [np.nan, 1.0]
WITHOUT.measured[:, 0] = np.nan
REFERENCE = comparison_of(trajectory_of(), kind="reference", sigma=None)
STEPS = (Step("local", 120.0, 40, 0.5), Step("many starts", 28.0, 300, 2.0, "settled"))
SEARCHED = {"steps": STEPS, "starts": (23, 0, 5), "initial_cost": 15087.7, "evaluations": 340}
HEATED = {"theta_names": ("tau_1", "tau_2", "tau_heat"), "parameters": {"tau_heat": np.array(0.8)}, "fixed": ()}
"""A parameter that is called like a transition time."""

FITS: dict[str, Fit] = {
    "good": made(),
    "sigma unknown": made(sigma_known=False, cost=0.28),
    "a reference signal": made(sigma_known=None, comparisons=((REFERENCE,),)),
    "no data": made(sigma_known=None, comparisons=((),)),
    "a channel without a value": made(comparisons=((WITHOUT,),)),
    "a search that settled": made(**SEARCHED),
    "a search that ran out of time": made(**SEARCHED | {"steps": (STEPS[0], replace(STEPS[1], ended="time"))}),
    "a first guess that cannot be integrated": made(
        steps=(Step("local", np.inf, 0, 0.1), Step("beam along the log", 28.0, 300, 2.0))
    ),
    "at the upper bound": made(**bound("upper bound")),
    "at a known jump": made(**bound("known jump")),
    "a mode collapsed": made(**mode_held("collapsed", 0.0)),
    "a mode at its minimum duration": made(**mode_held("minimum duration", 0.5, run="run1")),
    "at a kink": made(kinks=KINKS[:1], free_basis=np.eye(3)[:, 1:], cost=28.5),
    "at kinks": made(kinks=KINKS, free_basis=np.eye(3)[:, 2:], cost=29.0),
    "stopped at a kink": made(kinks=KINKS[:1], free_basis=np.eye(3)[:, 1:], status=Status.MAX_ITERATIONS),
    "an indefinite Hessian": made(hessian=np.diag([1.0, -4.0, 1.0]), status=Status.SADDLE),
    "a singular Hessian": made(**correlated(0.0), status=Status.SINGULAR),
    "a nearly singular Hessian": made(**correlated(1e-7)),
    "stopped in a valley": made(**correlated(1e-7), status=Status.MAX_ITERATIONS),
    "an unknown that is not determined": made(hessian=np.diag([1.0, 0.0, 1.0]), status=Status.SINGULAR),
    "called like a time": made(**HEATED, **correlated(1e-3), parameter_units={"tau_heat": ""}),
    "idle, and called like a time": made(**HEATED, idle=("tau_heat",), parameter_units={"tau_heat": ""}),
    "too few values": made(sigma_known=False, comparisons=((FEW,),)),
    "nothing finite": made(**NOTHING),
    "an integration error": made(integration_error=3e-5),
    "no integration error": made(integration_error=np.nan),
    "sigma too small": made(cost=4 * 28.0),
    "sigma too large": made(cost=28.0 / 4),
    "an array that is fixed": made(
        parameters={"mu": np.array(0.8), "table": np.arange(100.0)}, parameter_units={"mu": "1", "table": "K"},
        fixed=("table",),
    ),
    "two experiments": several(2, names=["dry", "wet"]),
    "a long message": made(status=Status.ERROR, reason=Issue("error", ("word " * 60,))),
    **{f"status {s.name}": made(status=s, idle=("tau_2",) if s is Status.COLLAPSED else ()) for s in Status},
}  # fmt: skip
CALLED = "mode 'm' compares with k at own.py:3"
REASONS = {
    "a wrong slope": Issue("wrong slope", (), {"before": -4.0, "after": 4.0}),
    "a jump": Issue("jump", ("k",), {"before": 0.49, "after": 2.49, "at": (0.3,)}),
    "a jump in two unknowns": Issue("jump", ("k", "c"), {"before": 0.49, "after": 2.49, "at": (0.3, 1.0)}),
    "a hidden switch": Issue("switch", ("k", CALLED), {"before": 1.0, "after": 2.0, "at": 0.3}),
    "a kink": Issue("kink", ("k",), {"before": -1.0, "after": 3.0, "at": (0.3,)}),
    "rounding": Issue("rounding", (), {"noise": 1e-3}),
    "a valley": Issue("valley"),
    "a valley with a delay": Issue("valley", (), {"delayed": 1.0}),
}
"""Why a line search failed."""
ENDS = {
    "at a kink": Termination(Status.CONVERGED_AT_KINK, kinks=(Kink("tau_1", 0.5, -0.7, 0.3),)),
    "after refinement": Termination(
        Status.MAX_ITERATIONS, iterations=12, earlier_iterations=9, optimality=0.5, tolerance=1e-7
    ),
    "saddle": Termination(Status.SADDLE, smallest_eigenvalue=-1.0),
    "flat": Termination(Status.SINGULAR, flat_direction=(("a", 0.71), ("b", -0.7)), smallest_eigenvalue=1e-14),
    "collapsed": Termination(Status.COLLAPSED, idle=("tau_1", "leak")),
    "infeasible": Termination(
        Status.INFEASIBLE, violated=(("terminal constraint 1", 1.5), ("terminal constraint 2", -2.0))
    ),
    "interrupted": Termination(Status.INTERRUPTED, iterations=3),
    "not finite": Termination(Status.NONFINITE_START),
    "error": Termination(sf.Status.ERROR, reason=Issue("error", ("KeyError: 3.",))),
    "at a bound": Termination(Status.CONVERGED, active=(ActiveConstraint("lower bound", 0.05, "mu"),)),
    **{f"line search: {name}": Termination(Status.LINE_SEARCH_FAILED, reason=r) for name, r in REASONS.items()},
}

REPORTS = SAVED / "reports.txt"
"""What is printed of `FITS` and `ENDS`, as it was read and approved.

``PYTHONPATH=tests python tests/report/test_fit_report.py`` writes it anew.
"""


@cache
def build_texts() -> dict[str, str]:
    """What is printed now: of every fit but the first, the paragraphs that are not in the report of the first."""
    good = report(FITS["good"])
    found = {
        name: "\n\n".join(part for part in report(fit).split("\n\n") if part not in good or name == "good")
        for name, fit in FITS.items()
    }
    for name, reason in REASONS.items():
        fit = made(status=Status.LINE_SEARCH_FAILED, reason=reason)
        found[f"verdict: {name}"] = report(fit).split("\n\n")[0]
    found |= {f"message: {name}": str(end) for name, end in ENDS.items()}
    return found | {"many unknowns": write_report(many_unknowns()), "many experiments": write_report(several(14))}


def read_texts() -> dict[str, str]:
    """The approved texts."""
    parts = REPORTS.read_text(encoding="utf-8").split("\n=== ")[1:]
    return {name: text.strip("\n") for name, _, text in (part.partition(" ===\n") for part in parts)}


APPROVED = read_texts()


@pytest.mark.parametrize("name", APPROVED)
def test_what_is_printed_is_what_was_approved(name):
    text = build_texts()[name].strip("\n")
    assert text == APPROVED[name]
    if not name.startswith("message"):
        assert all(len(line) <= 100 and line == line.rstrip() for line in text.splitlines())


def test_all_that_is_printed_was_approved():
    assert build_texts().keys() == APPROVED.keys()
    whole = report(several(14))
    assert all(f"run{e + 1}  " in whole for e in range(14))


@pytest.mark.parametrize("rounding", [-9.6e-18, 2.2e-16, 0.0])
def test_an_eigenvalue_of_the_size_of_rounding_is_zero(rounding):
    known = np.array([3.0, 5.0]) / np.hypot(3.0, 5.0)
    other = np.array([-known[1], known[0]])
    values = compute_scaled_spectrum(np.outer(known, known) + rounding * np.outer(other, other), np.eye(2))[0]
    assert values[0] == 0.0
    assert values[1] == pytest.approx(2.0)  # of a Hessian with a diagonal of one


@pytest.mark.parametrize("cost", [4 * 28.0, 28.0 / 4])
def test_sigma_is_wrong_only_where_it_is_given_and_the_fit_has_converged(cost):
    assert len(warnings_of(made(cost=cost))) == 1
    assert not warnings_of(made(cost=cost, sigma_known=False))
    assert not warnings_of(made(cost=cost, status=Status.MAX_ITERATIONS))
    assert not warnings_of(made(cost=28.0 * 1.3)), "chance explains it"


# --- figures ----------------------------------------------------------------------------------------------------------


def spans(ax) -> list[tuple[float, float]]:
    return [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in ax.patches]


def legend_of(figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_figure_of_a_fit():
    """Channels with their residuals, modes named above the first, the legend; a block for each run."""
    fit, each = made(), plot_fit(several(2, names=["dry", "wet"]))
    figure, without = plot_fit(fit, level=0.9), plot_fit(made(sigma_known=None, comparisons=((),)))
    assert [ax.get_ylabel() for ax in figure.axes] == ["X (m)", "residual\n(m)", "h", "residual"]
    assert [ax.get_xlabel() for ax in figure.axes] == ["", "", "", "time (s)"]
    assert [text.get_text() for text in figure.axes[0].texts] == ["stick", "slip", "stick"]
    assert legend_of(figure) == ["measured", "fitted", "± sigma", "transition", "transition, 90 % interval"]
    half = scipy.stats.norm.ppf(0.95) * fit.standard_errors[:2]
    ends = np.stack([fit.theta[:2] - half, fit.theta[:2] + half], axis=1)
    np.testing.assert_allclose(spans(figure.axes[0])[3:], ends, rtol=1e-12)
    assert [ax.get_ylabel() for ax in without.axes] == ["X (m)", "dX (m/s)"]
    assert [block.get_suptitle() for block in each.subfigs] == ["dry", "wet"]
    failed = plot_fit(made(status=Status.MAX_ITERATIONS))
    assert failed.legends[0].get_title().get_text() == "Not a minimum: max iterations"


def test_a_channel_and_its_residuals():
    """A curve that is broken where states jump; residuals between their sigmas."""
    comparison = comparison_of(trajectory_of())
    above, below = Figure().subplots(2)
    plot_comparison(comparison, 0, above)
    plot_residuals(comparison, 0, below)
    samples, curve = above.lines
    np.testing.assert_array_equal(samples.get_ydata(), comparison.measured[:, 0])
    x, y = curve.get_data()
    assert x[np.isnan(y)].tolist() == [4.0, 7.0]
    np.testing.assert_array_equal(y[~np.isnan(y)], comparison.curve[:, 0])
    _, residuals, upper, lower = below.lines
    np.testing.assert_array_equal(residuals.get_ydata(), comparison.residuals[:, 0])
    assert (set(upper.get_ydata()), set(lower.get_ydata())) == ({0.1}, {-0.1})


def test_modes_are_shaded_and_named_with_one_colour_for_each():
    modes, times = ("before", "impact", "gone", "collapsed", "before"), (0.0, 4.0, 4.4, 4.41, 4.41, 10.0)
    ax = Figure(figsize=(8, 3)).subplots()
    plot_modes(trajectory_of(modes, times), ax)
    np.testing.assert_allclose(spans(ax), [(0.0, 4.0), (4.0, 4.4), (4.4, 4.41), (4.41, 10.0)])
    assert [text.get_text() for text in ax.texts] == ["before", "impact", "before"]
    before, impact, gone, again = (patch.get_facecolor() for patch in ax.patches)
    assert before == again
    assert len({before, impact, gone}) == 3


def test_a_time_at_a_kink_has_its_interval_in_the_table():
    """The standard error does not say that J is steep to the left."""
    times = 0.5 * np.arange(1, 41)
    values = np.where(times < 2.0, times, 4.0 - times) + 0.5 * (times == 2.0)
    system = sf.HybridSystem({"up": lambda t, x, p: 1.0 + 0.0 * x, "down": lambda t, x, p: -1.0 + 0.0 * x}, [0.0])
    run = sf.Experiment(sf.Measurements(times, values, sigma=0.05), ("up", "down"), (3.0,), t0=0.0)
    assert "95 % in [1.9962, 2.0082], AT A KINK" in str(sf.estimate(sf.Problem(system, run)))


# --- sentences --------------------------------------------------------------------------------------------------------


def test_fields_of_sentences_are_words_or_figures():
    """A field of another name would be written as nan."""
    library = Path(sf.__file__).parent
    sources = (path for path in library.rglob("*.py") if "report" not in path.parts)
    nodes = itertools.chain.from_iterable(ast.walk(ast.parse(path.read_text())) for path in sources)
    known = {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    templates = [text for text in (*issues._ISSUES.values(), *verdict.REASONS.values()) if isinstance(text, str)]
    found = {field for text in templates for _, field, *_ in Formatter().parse(text) if field}
    assert len(found) > 20
    assert {field for field in found if not field.isdigit()} <= templates_module._WORDS.keys() | known


if __name__ == "__main__":
    REPORTS.write_text("".join(f"\n=== {name} ===\n{text}\n" for name, text in build_texts().items()), encoding="utf-8")
