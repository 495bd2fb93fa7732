"""Jumps of the state at known times: doses into one compartment, against closed forms and copies of the mode."""

import dataclasses
import datetime as dt
from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.optimize import least_squares

import switchfit as sf
from support.doses import ALL, AMOUNT, BODY, DOSES, GUESS, TIMES, TRUE, concentration, dose, make_log, make_problem
from support.models import decay as eliminate
from support.models import one_run, refused
from switchfit.cli.summaries import summarize_estimate
from switchfit.engine.native.foreign import foreign_derivatives
from switchfit.engine.native.library_places import places_in_library
from switchfit.fit.collapsed_modes import idle_unknowns
from switchfit.io.problem_file.loading import load_problem, read_experiments
from switchfit.meshes.evaluator import Evaluator
from switchfit.problem.functions import use_float64
from switchfit.report.html.curves import collect_curves
from switchfit.report.problem import write_experiments

WALL = sf.Jump("2024-05-01 16:00", dose)
UNDEFINED = sf.Jump(1.0, lambda t, x, p: x / 0.0)


@pytest.fixture(scope="module")
def values():
    return concentration(**TRUE)[0] + 0.1 * np.random.default_rng(3).standard_normal(len(TIMES))


@pytest.fixture(scope="module")
def fit(values):
    return sf.estimate(make_problem(values))


def test_fit_ends_where_least_squares_of_the_closed_form_ends(fit, values):
    other = least_squares(lambda at: (concentration(*at)[0] - values) / 0.1, [0.2, 8.0], xtol=1e-14, gtol=1e-14)
    np.testing.assert_allclose(fit.theta, other.x, rtol=1e-6)
    assert fit.verdict.level == "good"
    assert fit.trajectory.mode_spans == [("eliminate", 0.0, 36.0)]
    np.testing.assert_array_equal(fit.trajectory.jump_times, DOSES)
    assert fit.initial_state[0] == 0.0  # before the dose at t0
    assert "eliminate, 0 to 36 h, 4 jumps at 0, 8, 16, 24 h" in str(fit)
    assert sf.check_derivatives(make_problem(values)).passed  # the paper's equations, too


# --- with transitions -------------------------------------------------------------------------------------------------


CHANGING = sf.HybridSystem({"slow": eliminate, "fast": lambda t, x, p: -3 * p["k"] * x}, [0.0])


def make_changing(values, guess=10.5, system=CHANGING, **options):
    """Elimination becomes three times as fast at an unknown time."""
    log = sf.Measurements(TIMES, values, sigma=0.05)
    return one_run(system, log, ["slow", "fast"], [guess], None, GUESS, time_unit="h", jumps=[ALL], **options)


def simulate_changing(tau):
    """The exact concentrations at the true parameters."""
    rest = np.where(TIMES[:, None] <= tau, TIMES[:, None], tau + 3 * (TIMES[:, None] - tau))
    given = np.where(tau >= DOSES, DOSES, tau + 3 * (DOSES - tau))
    since = rest - given
    return np.where(TIMES[:, None] > DOSES, AMOUNT / TRUE["V"] * np.exp(-TRUE["k"] * since), 0.0).sum(1)


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_a_transition_between_jumps_is_found(engine):
    problem = make_changing(simulate_changing(13.3), engine=engine)
    assert problem.theta_names == ("tau_1", "k", "V")
    assert (problem.unknowns.lower[0], problem.unknowns.upper[0]) == (8.0, 16.0)
    fit = sf.estimate(problem)
    np.testing.assert_allclose(fit.theta, [13.3, 0.13, 11.0], rtol=1e-6)
    assert [mode for mode, _, _ in fit.trajectory.mode_spans] == ["slow", "fast"]
    assert [(t.before, t.after) for t in fit.transitions] == [("slow", "fast")]


def test_room_for_more_transitions_changes_no_derivative():
    """As many as there are jumps, whose times are no unknowns: the numbers of unknowns are then the same."""
    values = simulate_changing(13.3)
    found, expected = (Evaluator(make_changing(values, max_transitions=most)) for most in (5 + len(DOSES), None))
    theta = expected.problem.initial_theta
    for name in ("cost", "gradient", "hessian"):
        np.testing.assert_allclose(getattr(found(theta), name), getattr(expected(theta), name), rtol=1e-9)


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_the_sample_at_a_jump_is_of_the_state_before_on_both_sides_of_a_kink(engine):
    """The derivative to the left of a kink must not put the jumps before the samples at the same times."""
    evaluator = Evaluator(make_changing(simulate_changing(13.3), guess=13.0, engine=engine))
    theta = evaluator.problem.initial_theta  # tau_1 = 13 is a sample, too
    for side in (-1, 1):
        found = evaluator(theta, side)
        assert found.cost == pytest.approx(evaluator(theta, 1).cost, rel=1e-12)
        moved = evaluator.cost(theta + side * 1e-6 * (np.arange(3) == 0))
        assert found.gradient[0] == pytest.approx((moved - found.cost) / (side * 1e-6), rel=1e-4)
        for method in ("adjoint", "forward") if engine == "jax" else ():
            np.testing.assert_allclose(evaluator(theta, side, method).gradient, found.gradient, rtol=1e-6)


def test_the_same_inside_the_programs_of_batches():
    evaluator = Evaluator(make_changing(simulate_changing(13.3), guess=13.0))
    problem, (arguments,), theta = evaluator.problem, evaluator.arguments, evaluator.problem.initial_theta
    (structure,), own = problem.structures, problem.own_places[0][0]
    places = places_in_library(structure)
    with use_float64():
        program = jax.jit(lambda tau, p, side: foreign_derivatives(structure, arguments, tau, p, side, places))
        for side in (-1.0, 1.0):
            J, g, _ = map(np.asarray, program(*problem.vectors(theta, 0), side))
            expected = evaluator(theta, int(side))
            assert float(J) == pytest.approx(expected.cost, rel=1e-12)
            np.testing.assert_allclose(g[own], expected.gradient, rtol=1e-10)


def test_a_transition_that_wants_past_a_jump_stops_there_and_says_so():
    """The guess says between which jumps it lies; one that is proposed keeps away from them."""
    fit = sf.estimate(make_changing(simulate_changing(18.0), guess=12.0), strategy="local")
    assert [str(active) for active in fit.active] == ["tau_1 at the known jump at 16"]
    assert "no transition passes: tau_1 at 16: put the guess of tau_1 on the other side" in str(fit.verdict)
    after = sf.estimate(make_changing(simulate_changing(18.0), guess=17.0))
    np.testing.assert_allclose(after.theta, [18.0, 0.13, 11.0], rtol=1e-6)
    run = sf.Experiment(make_log(TIMES), ["slow", "fast"], None, t0=0.0, tf=36.0, jumps=sf.Jump(18.0, dose))
    assert 18.0 < run.initial_times[0] < 36.0


def test_a_collapsed_mode_with_a_jump_inside_is_not_idle():
    """Its two transition times cannot move together: one is before the jump, the other after it; nor if the modes
    before and behind it differ."""

    def make(jumps, sequence=("slow", "fast", "slow"), **more):
        run = sf.Experiment(make_log(TIMES), sequence, [7.5, 8.5], t0=0.0, jumps=jumps)
        return Evaluator(sf.Problem(replace(CHANGING, **more), run, GUESS))

    theta = np.array([8.0, 8.0, 0.2, 8.0])
    assert idle_unknowns(make([]), theta, False).any()
    assert not idle_unknowns(make(sf.Jump(8.0, dose)), theta, False).any()
    three = CHANGING.modes | {"third": lambda t, x, p: -2.0 * p["k"] * x}
    assert not idle_unknowns(make([], ("slow", "fast", "third"), modes=three), theta, False).any()
    assert not idle_unknowns(make([], reset_maps={("slow", "fast"): lambda t, x, p: 0.5 * x}), theta, False).any()


def test_with_a_free_final_time():
    """The time at which the state, refilled twice, has fallen to 1."""
    system = sf.HybridSystem({"run": lambda t, x, p: -x}, [1.0])
    data = [sf.RunningCost(lambda t, x, p: 1.0), sf.TerminalConstraint(lambda x, p: x[0] - 1.0)]
    refill = sf.Jump([0.0, 1.0], lambda t, x, p: x + 2.0)
    fit = sf.estimate(one_run(system, data, ["run"], [], sf.Parameter(1.5, upper=6.0), jumps=[refill]))
    assert fit.theta[0] == pytest.approx(1.0 + np.log(3 * np.exp(-1.0) + 2.0), rel=1e-6)


def test_names_of_guards_count_transitions_alone():
    level = AMOUNT / TRUE["V"] * np.exp(-TRUE["k"] * np.array([12.0, 4.0])).sum()  # at 12 h, after two doses
    guards = {("slow", "fast"): lambda t, x, p: x[0] - level}
    problem = make_changing(simulate_changing(12.0), 11.0, system=dataclasses.replace(CHANGING, guards=guards))
    assert problem.constraint_names == ("guard of tau_1 (slow -> fast)",)
    np.testing.assert_allclose(sf.estimate(problem).theta, [12.0, 0.13, 11.0], rtol=1e-6)


def wait(t, x, p):
    return 0.0 * p["k"] * x


# --- maps, several jumps ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_jumps_at_one_time_act_in_order(engine):
    add, double = sf.Jump(1.0, lambda t, x, p: x + 1.0), sf.Jump(1.0, lambda t, x, p: 2.0 * x)
    system = sf.HybridSystem({"rest": wait}, [3.0])
    for jumps, expected in (([add, double], 8.0), ([double, add], 7.0)):
        log = sf.Measurements([1.0, 2.0], [3.0, expected], sigma=1.0)
        problem = sf.Problem(system, sf.Experiment(log, ["rest"], [], jumps=jumps), {"k": 1.0}, engine=engine)
        assert sf.evaluate(problem).cost == pytest.approx(0.0, abs=1e-18)
        assert sf.simulate(problem).states[-1] == expected


def test_at_the_time_of_a_fixed_transition_the_jump_comes_first():
    system = sf.HybridSystem({"a": wait, "b": wait}, [3.0], {("a", "b"): lambda t, x, p: 2.0 * x})
    log = sf.Measurements([1.0, 2.0], [3.0, 8.0], sigma=1.0)
    known, add = sf.Parameter(1.0, fixed=True), sf.Jump(1.0, lambda t, x, p: x + 1.0)
    problem = sf.Problem(system, sf.Experiment(log, ["a", "b"], [known], t0=0.0, jumps=add), {"k": 1.0})
    for side in (-1, 1):
        assert Evaluator(problem)(problem.initial_theta, side).cost == pytest.approx(0.0, abs=1e-18)


# --- many fits, files, reports ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_logs_with_other_times_of_doses_are_not_confused():
    """The times of jumps are no unknowns: problems that differ in them alone cost differently."""
    clean = concentration(**TRUE)[0]
    problems = make_problem(clean), make_problem(clean, jumps=sf.Jump([0.0, 9.0, 16.0, 24.0], dose))
    fits = sf.estimate_many(problems)
    np.testing.assert_allclose(fits.theta, [sf.estimate(problem).theta for problem in problems], rtol=1e-6)
    assert fits.cost[0] < 1e-8 < fits.cost[1]


MODEL = """
import switchfit as sf
def eliminate(t, x, p):
    return -p["k"] * x
def give(amount):
    return lambda t, x, p: x + amount / p["V"]
dose = give(100.0)
body = sf.HybridSystem({"eliminate": eliminate}, [0.0], state_names=("c",))
"""

FILE = """
model = "model.py:body"
parameters.k = 0.2
parameters.V = { value = 8.0, lower = 1.0 }
[experiments]
mode_sequence = ["eliminate"]
time_unit = "h"
t0 = 0.0
[[experiments.jumps]]
time = [0.0, 8.0, 16.0]
map = "model.py:dose"
[[experiments.jumps]]
time = 24
map = { name = "model.py:give", arguments = { amount = 100.0 } }
[experiments.data]
file = "log.csv"
columns = ["c"]
sigma = 0.1
"""


@pytest.fixture
def folder(tmp_path, values):
    write_log(tmp_path, TIMES.tolist(), values)
    (tmp_path / "model.py").write_text(MODEL)
    (tmp_path / "problem.toml").write_text(FILE)
    return tmp_path


def write_log(folder, times, values):
    rows = [f"{t},{c!r}\n" for t, c in zip(times, values.tolist(), strict=True)]
    (folder / "log.csv").write_text("t,c\n" + "".join(rows))


def test_problem_file(folder, values):
    problem = load_problem(folder / "problem.toml").problem
    assert sf.evaluate(problem).cost == pytest.approx(sf.evaluate(make_problem(values)).cost, rel=1e-9)
    runs = read_experiments(folder / "problem.toml")
    assert "4 jumps at 0, 8, 16, 24 h" in write_experiments(runs.experiments)


START = dt.datetime(2024, 5, 1, 6, tzinfo=dt.UTC)


def at(hour):
    return (START + dt.timedelta(hours=float(hour))).isoformat()


def make_dated(values, jumps, origin=None, **more):
    log = sf.Measurements([at(hour) for hour in TIMES], values, sigma=0.1)
    run = sf.Experiment(log, ["eliminate"], [], time_unit="h", jumps=jumps, origin=origin, **more)
    return sf.Problem(BODY, run, GUESS)


def test_times_may_be_dates(fit, values):
    """With their zone, or as the reading of a wall clock in Berlin, two hours before UTC in May."""
    wall = sf.Jump("2024-05-02 08:00", dose)
    dated = make_dated(values, [sf.Jump([at(hour) for hour in DOSES[:3]], dose), wall], time_zone="Europe/Berlin")
    found = sf.estimate(dated)
    np.testing.assert_array_equal(found.theta, fit.theta)
    assert "4 jumps at 2024-05-01 08:00" in " ".join(str(found).split())
    (summary,) = summarize_estimate(found)["runs"]
    expected = [START + dt.timedelta(hours=float(hour)) for hour in DOSES]
    assert [dt.datetime.fromisoformat(date) for date in summary["jump_dates"]] == expected
    copy = dataclasses.replace(dated.experiments[0], name="again")  # its jumps are numbers by now
    np.testing.assert_array_equal(copy.jump_times, DOSES)
    late = sf.Jump(at(8), dose)  # an origin that only the jump needs
    run = sf.Experiment(make_log(values), ["eliminate"], [], time_unit="h", jumps=late, origin=START.isoformat())
    np.testing.assert_array_equal(run.jump_times, [8.0])


def test_problem_file_with_dates(folder, values):
    write_log(folder, map(at, TIMES), values)
    text = FILE.replace("[0.0, 8.0, 16.0]", "[2024-05-01T06:00:00Z, 2024-05-01T14:00:00Z, '2024-05-01T22:00Z']")
    text = text.replace("time = 24", "time = 2024-05-02T08:00:00+02:00").replace("t0 = 0.0\n", "")
    (folder / "problem.toml").write_text(text)
    problem = load_problem(folder / "problem.toml").problem
    np.testing.assert_array_equal(problem.experiments[0].jump_times, DOSES)
    assert "4 jumps at 2024-05-01 06:00, 2024-05-01 14:00" in write_experiments(problem.experiments)


def test_problem_file_with_a_wrong_jump(folder):
    (folder / "problem.toml").write_text(FILE.replace('"model.py:dose"', '"model.py:doze"'))
    with pytest.raises(ValueError, match=r"jumps\[1\].map .*defines no 'doze'"):
        load_problem(folder / "problem.toml")


def test_figure_page_and_file_have_the_jumps(fit, tmp_path):
    line = next(line for line in fit.plot().axes[0].lines if line.get_label() == "fitted")
    times, curve = line.get_data()
    heights = [np.subtract(*curve[times == time][[-1, 0]]) for time in DOSES]  # vertical, without a gap
    np.testing.assert_allclose(heights, AMOUNT / fit.parameters["V"])
    fit.save(tmp_path / "fit.json")
    np.testing.assert_array_equal(sf.Estimate.load(tmp_path / "fit.json").trajectory.jump_times, DOSES)
    # The curves of the page are divided at the jumps; their derivatives have no jump's size.
    (curves, *_) = collect_curves(fit, 0, [0, 1], 2000)
    times, step = curves.curve["t"], 0.1 * fit.standard_errors[0]
    breaks = np.flatnonzero(np.isnan(times))
    np.testing.assert_array_equal([times[breaks - 1], times[breaks + 1]], [DOSES, DOSES])
    path = sf.simulate(fit.problem, fit.theta + np.array([step, 0.0]))
    there = np.isfinite(times) & ~np.isin(times, DOSES)
    exact = np.interp(times[there], path.times, path.states[:, 0])
    linear = (curves.curve["y0"] + step * curves.curve["d0_0"])[there]
    assert np.abs(exact - linear).max() < 1e-3 * np.ptp(exact)


def test_prediction_and_profile_know_the_jumps(fit):
    bands = sf.predict(fit, times=[7.999, 8.001])
    assert np.diff(bands.outputs[:, 0]) == pytest.approx(AMOUNT / fit.parameters["V"], rel=1e-3)
    low, high = fit.profile("k").interval()
    assert low < fit.parameters["k"] < high


# --- what is wrong ----------------------------------------------------------------------------------------------------


def make_jumping(*jumps):
    return make_problem(TIMES, list(jumps))


test_what_is_wrong_is_said = refused(
    (lambda: sf.Jump([], dose), ValueError, "Jump time must be a number or a sequence of numbers that"),
    (lambda: sf.Jump([2.0, 1.0], dose), ValueError, "Jump time .* that increase strictly; got \\[2.0, 1.0\\]"),
    (lambda: sf.Jump(1.0, 5.0), TypeError, "Jump map must be a function map\\(t, x, p\\); got 5.0"),
    (lambda: sf.Jump("noon", dose), ValueError, "Jump time must be a number or a date; got 'noon'. Write dates as"),
    (lambda: sf.Jump([at(0), 1.0], dose), TypeError, "Jump time must be numbers or dates, not both; got 1.0"),
    (lambda: make_dated(TIMES, sf.Jump([at(8), at(36)], dose)), ValueError, "the first is 2024-05-02 18:00:00"),
    (lambda: make_dated(TIMES, WALL), ValueError, "Measurements has a time zone .*, but times of Jump has none"),
    (lambda: make_jumping(WALL), ValueError, "times of Jump is a date, but not all times of the data are"),
    (lambda: make_jumping(sf.Jump(36.0, dose)), ValueError, "\\[0.0, 36.0, the end left out\\]; .* first is 36.0"),
    (lambda: sf.evaluate(make_changing(TIMES), [18.0, 0.1, 9.0]), ValueError, "another side of the jump at 16. Give"),
    (lambda: sf.evaluate(make_changing(TIMES), [7.0, 0.1, 9.0]), ValueError, "another side of the jump at 8. Give"),
    (lambda: make_jumping(sf.Jump(-1.0, dose)), ValueError, "1 of 1 do not, the first is -1.0"),
    (lambda: make_jumping(dose), TypeError, "jumps must be an sf.Jump or a list of them; got function"),
    (lambda: make_jumping(sf.Jump(1.0, lambda t, x, p: np.zeros(2))), ValueError, "the map of a Jump.*\\(2,\\)"),
    (lambda: make_changing(TIMES, guess=8.0), ValueError, "guess of transition time 1 is 8.0, the time of a jump"),
    (lambda: make_changing(TIMES, max_transitions=4), ValueError, "max_transitions is 4, but .* has 5 transitions"),
    (lambda: sf.simulate(make_jumping(UNDEFINED)), ValueError, "the map of a Jump at t = 1 h"),
)
