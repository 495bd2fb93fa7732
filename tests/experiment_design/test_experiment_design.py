"""Experiment design: information, criteria, samples, sensors and inputs, against closed forms and brute force."""

import csv
import json
import tomllib
from dataclasses import replace
from itertools import combinations, product

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.commands import catch_settings, run
from support.models import STILL, curve, decay, first_state, refused
from switchfit.experiment_design.input_search import _describe, differentiate_criterion
from switchfit.experiment_design.inputs import replace_inputs, stack_inputs
from switchfit.experiment_design.nominal import Nominal, simulate_values
from switchfit.experiment_design.samples import Candidates, choose_samples
from switchfit.experiment_design.search import _build_criterion
from switchfit.io.problem_file.loading import load_problem
from switchfit.meshes.evaluator import Evaluator
from switchfit.models import heater_problem
from switchfit.problem.functions import use_float64

TIMES = np.linspace(0.0, 4.0, 9)


def planned(times, channels=1, **settings):
    """Samples that are not made yet."""
    return sf.Measurements(times, np.zeros((len(times), channels)), **({"sigma": 0.1} | settings))


def line(times=TIMES, parameters=None, **settings):
    """a + b t, with a = 1 and b = 2."""
    data = planned(times, observe=lambda t, x, p: jnp.stack([p["a"] + p["b"] * t]), **settings)
    return sf.Problem(STILL, sf.Experiment(data, ("still",), (), 0.0, 4.0), {"a": 1.0, "b": 2.0} | (parameters or {}))


def line_information(times, sigma=0.1):
    slopes = np.stack([np.ones(len(times)), times])
    return slopes @ slopes.T / sigma**2


def decaying(times, **parameters):
    """x = start exp(-k t), with k = 0.5."""
    system = sf.HybridSystem({"decay": decay}, lambda p: jnp.stack([p["start"]]))
    return sf.Problem(system, sf.Experiment(planned(times), ("decay",), (), 0.0, 8.0), {"k": 0.5} | parameters)


def lag(values, *, kind="hold", parameters=None, data=None, **settings):
    """x' = -k x + b u, y = x, u at knots."""
    system = sf.HybridSystem({"on": lambda t, x, p, u: -p["k"] * x + p["b"] * u}, [0.0])
    knots = np.linspace(0.0, 4.0, len(values) + (kind == "hold"))[: len(values)]
    data = planned(TIMES[1:], **(data or {}))
    run = sf.Experiment(data, ("on",), (), 0.0, 4.0, inputs=sf.Input(knots, values, kind=kind))
    return sf.Problem(system, run, {"k": 0.7, "b": 2.0} | (parameters or {}), **settings)


def two_lags():
    """Two runs with inputs and samples of their own, a gain of its own and an unknown initial state of the first."""
    one = lag([1.0, -0.4])
    first = replace(one.experiments[0], initial_state=[sf.Parameter(0.3)], parameter_map={"b": "b_first"})
    second = replace(one.experiments[0], data=planned(TIMES[2:6], sigma=0.2))
    return sf.Problem(one.system, [first, second], {"k": 0.7, "b": 2.0, "b_first": 1.5})


def transitions_at_knots():
    """A lag that is twice as fast between the knots at 1 s and 3 s."""
    one = lag([1.0, -0.4, 0.3, 0.8])
    fast = lambda t, x, p, u: -2.0 * p["k"] * x + p["b"] * u  # noqa: E731
    system = sf.HybridSystem({"slow": one.system.modes["on"], "fast": fast}, [0.0])
    run = replace(one.experiments[0], mode_sequence=("slow", "fast", "slow"), transition_times=(1.0, 3.0))
    return sf.Problem(system, run, {"k": 0.7, "b": 2.0})


# Information


def test_information_of_a_line_does_not_depend_on_values_but_on_missing_ones():
    problem = line()
    (data,) = problem.experiments[0].data
    values = np.random.default_rng(0).normal(size=(9, 1))
    values[2] = np.nan
    plan = sf.design(replace(problem, experiments=replace(problem.experiments[0], data=replace(data, values=values))))
    np.testing.assert_allclose(plan.covariance, np.linalg.inv(line_information(np.delete(TIMES, 2))), rtol=1e-12)
    np.testing.assert_allclose(plan.standard_errors**2, np.diag(plan.covariance))
    assert plan.criterion_after == pytest.approx(np.log(np.linalg.det(plan.covariance)), abs=1e-12)
    assert plan.criterion_before == plan.criterion_after


def test_priors_and_other_runs_are_information():
    problem = line()
    first = replace(problem.experiments[0], name="first")
    second = replace(first, name="second", data=planned(TIMES[:3], observe=first.data[0].observe, sigma=0.2))
    parameters = {"a": sf.Parameter(1.0, prior=sf.Normal(1.0, 0.05)), "b": 2.0}
    plan = sf.design(sf.Problem(STILL, [first, second], parameters), samples=2)
    assert plan.run == "second"
    (times,) = plan.sample_times.values()
    F = line_information(TIMES) + line_information(times, 0.2) + np.diag([0.05**-2.0, 0.0])
    others = F - line_information(times, 0.2)
    choices = combinations(TIMES[:3], 2)
    best = max(choices, key=lambda pair: np.linalg.det(others + line_information(np.array(pair), 0.2)))
    np.testing.assert_array_equal(times, best)  # 0 and 0.5; without all else it would be 0 and 1
    np.testing.assert_allclose(plan.covariance, np.linalg.inv(F), rtol=1e-10)
    assert len(plan.problem.experiments[0].data[0].times) == 9


def test_a_sigma_that_is_a_parameter_and_a_robust_loss():
    """The loss counts as normal noise."""
    plan = sf.design(line(sigma="noise", parameters={"noise": sf.Parameter(0.1, lower=0.01)}))
    np.testing.assert_allclose(plan.covariance[:2, :2], np.linalg.inv(line_information(TIMES)), rtol=1e-10)
    assert plan.standard_errors[2] == pytest.approx(0.1 / np.sqrt(2 * 9), rel=1e-10)
    np.testing.assert_allclose(sf.design(line(loss="huber")).covariance, plan.covariance[:2, :2], rtol=1e-9)


def test_guarded_times_are_no_unknowns_of_their_own():
    """The covariance is that of the parameters, and of guarded times as functions of them."""
    fall = {"air": lambda t, x, p: jnp.stack([x[1], -p["g"] + 0.0 * x[0]])}
    bounce = {("air", "air"): lambda t, x, p: jnp.stack([x[0], -p["e"] * x[1]])}
    system = sf.HybridSystem(fall, [1.0, 0.0], bounce, guards={("air", "air"): lambda t, x, p: x[0]})
    data = planned(np.linspace(0.1, 1.5, 15), observe=first_state, sigma=0.01)
    problem = sf.Problem(system, sf.Experiment(data, ("air", "air"), (0.5,), 0.0, 1.5), {"g": 9.8, "e": 0.8})
    plan = sf.design(problem)
    exact = sf.evaluate_on_guards(plan.problem, plan.theta)
    np.testing.assert_allclose(plan.covariance[1:, 1:], np.linalg.inv(exact.hessian), rtol=1e-6)
    of_time = exact.times_slope @ np.linalg.inv(exact.hessian) @ exact.times_slope.T
    assert plan.standard_errors[0] ** 2 == pytest.approx(of_time.item(), rel=1e-6)
    assert plan.theta[0] == pytest.approx(np.sqrt(2 / 9.8), rel=1e-6)
    assert sf.design(problem, samples=3, names=["g", "e"]).undetermined == ()


def test_what_cannot_be_determined_is_named():
    still = lag(np.zeros(4))
    plan = sf.design(still)
    assert plan.undetermined == ("k", "b")
    assert np.isinf(plan.criterion_after)
    assert "cannot determine k, b" in " ".join(str(plan).split())
    moved = sf.design(still, free={"u": (-1.0, 1.0)})
    assert moved.undetermined == ()
    assert np.isinf(moved.criterion_before)
    assert np.isfinite(moved.criterion_after)
    of_product, guess = (lambda t, x, p: jnp.stack([p["a"] * p["b"] * t])), {"a": 1.0, "b": 2.0}
    assert sf.design(curve(of_product, TIMES, TIMES, guess, tf=4.0, sigma=1.0)).undetermined == ("a", "b")


def test_a_transition_at_a_sample_counts_half_from_each_side():
    near = [sf.design(heater_problem(), [2.0 + step, 0.5]) for step in (-1e-7, 0.0, 1e-7)]
    before, at, after = (np.linalg.inv(plan.covariance) for plan in near)
    assert abs(before[0, 0] - after[0, 0]) > 0.2 * at[0, 0]
    np.testing.assert_allclose(at, 0.5 * (before + after), rtol=1e-5)


def test_standard_errors_beyond_the_next_transition_are_doubtful():
    assert sf.design(heater_problem(), samples=4).doubtful == ()
    problem = heater_problem()
    late = planned([4.0, 5.0], sigma=3.0, names=("thermometer",))
    plan = sf.design(replace(problem, experiments=replace(problem.experiments[0], data=late)), names="k")
    assert plan.standard_errors[0] > 2.0
    assert plan.doubtful == ("tau_1", "k")
    assert "The standard error of tau_1, k is larger than the distance to a bound" in " ".join(str(plan).split())


# Samples and sensors


def test_samples_of_a_decay_are_taken_at_0_and_at_1_over_k():
    known = sf.design(decaying(np.linspace(0.1, 8.0, 80), start=sf.Parameter(1.0, fixed=True)), samples=1)
    np.testing.assert_allclose(known.sample_times["sensor 1"], [2.0])
    unknown = sf.design(decaying(np.linspace(0.0, 8.0, 81), start=3.0), samples=2)
    np.testing.assert_allclose(unknown.sample_times["sensor 1"], [0.0, 2.0])


def measure(kind, C):
    values = np.linalg.eigvalsh(C)
    return {"D": np.log(values).sum(), "A": values.sum(), "E": values.max()}[kind]


@pytest.mark.parametrize("kind", ["D", "A", "E"])
@pytest.mark.parametrize("names", [["b"], {"a": 0.1, "b": 3.0}])
def test_samples_against_all_choices(kind, names):
    times = np.array([0.0, 0.3, 0.9, 1.0, 1.6, 2.5, 2.6, 3.3, 4.0])
    sigma = np.random.default_rng(1).uniform(0.05, 0.3, (9, 1))
    plan = sf.design(line(times, sigma=sigma), criterion=kind, names=names, samples=4)
    scales = np.array(list(names.values()) if isinstance(names, dict) else [1.0, 1.0])
    own = slice(1, 2) if names == ["b"] else slice(None)
    every = {}
    for chosen in map(list, combinations(range(9), 4)):
        F = sum(line_information(times[[k]], sigma[k, 0]) for k in chosen)
        every[tuple(chosen)] = measure(kind, (np.linalg.inv(F) / np.outer(scales, scales))[own, own])
    best = min(every, key=every.get)
    assert plan.criterion_after == pytest.approx(every[best], rel=1e-9)
    np.testing.assert_array_equal(plan.sample_times["sensor 1"], times[list(best)])
    np.testing.assert_array_equal(plan.problem.experiments[0].data[0].sigma, sigma[list(best)])


def sensors_of_a_line():
    """Three sensors: the value, its slope, and the value again with less noise."""
    value = lambda t, x, p: jnp.stack([p["a"] + p["b"] * t])  # noqa: E731
    items = [
        planned(TIMES, observe=value, names=("value",)),
        planned(TIMES[::2], observe=lambda t, x, p: jnp.stack([p["b"] + 0.0 * t]), names=("slope",)),
        planned(TIMES, observe=value, sigma=0.05, names=("fine",)),
    ]
    return sf.Problem(STILL, sf.Experiment(items, ("still",), (), 0.0, 4.0), {"a": 1.0, "b": 2.0})


def test_no_exchange_of_one_sample_is_better():
    """Of random candidates of two sensors; dropping those that are missed least does not get there by itself."""
    rng, sensor = np.random.default_rng(0), np.arange(14) % 2
    slopes = rng.normal(size=(20, 14, 3))
    for each in np.einsum("rni,rnj->rnij", slopes, slopes):
        candidates = Candidates(sensor, each, 0.1 * np.eye(3))

        rate = lambda F: -np.linalg.slogdet(F)[1]  # noqa: E731
        value, taken = choose_samples(candidates, np.array([2, 3]), rate)
        np.testing.assert_array_equal(np.bincount(sensor, taken), [2, 3])
        for out, into in product(np.flatnonzero(taken), np.flatnonzero(~taken)):
            if sensor[out] == sensor[into]:
                assert rate(candidates.add(taken) - each[out] + each[into]) > value - 1e-6


def test_sensors_by_number_and_by_cost():
    problem = sensors_of_a_line()
    slopes = np.diag([0.0, len(TIMES[::2]) / 0.1**2])
    each = {"value": line_information(TIMES), "slope": slopes, "fine": line_information(TIMES, 0.05)}
    costs = {"value": 1.0, "slope": 1.5, "fine": 2.5}
    by_number, by_cost = ({"sensors": 2}, 2, dict.fromkeys(each, 1)), ({"sensors": costs, "budget": 3.5}, 3.5, costs)
    for settings, most, price in (by_number, by_cost):
        plan = sf.design(problem, **settings)
        found = {}
        for taken in product((0, 1), repeat=3):
            names = [name for name, use in zip(each, taken, strict=True) if use]
            F = sum((each[name] for name in names), np.zeros((2, 2)))
            if sum(price[name] for name in names) <= most and np.linalg.det(F) > 1e-6:
                found[tuple(names)] = measure("D", np.linalg.inv(F))
        assert tuple(plan.sample_times) == min(found, key=found.get)
        assert plan.criterion_after == pytest.approx(min(found.values()), rel=1e-9)
        assert len(plan.problem.experiments[0].data) == len(plan.sample_times)
    plan = sf.design(problem, samples={"value": 2, "slope": 1})
    assert {name: len(times) for name, times in plan.sample_times.items()} == {"value": 2, "slope": 1, "fine": 9}


def test_shares_of_the_information_add_up_to_one():
    plan = sf.design(line(), samples=4, criterion="A")
    share = plan.shares["sensor 1"][np.isin(TIMES, plan.sample_times["sensor 1"])]
    assert share.sum() == pytest.approx(1.0, abs=1e-9)
    assert (plan.shares["sensor 1"] > 0).all()


# Inputs


KNOTS = [1.0, -0.4, 0.3, 0.8]
NOISE_AND_DELAY = {"noise": sf.Parameter(0.1, lower=0.01), "late": sf.Parameter(0.2, lower=0.0, upper=0.4)}
PROBLEMS = {
    "linear, E": (lag(KNOTS, kind="linear"), 20.0),
    "cubic": (lag([*KNOTS, 0.2], kind="cubic"), 0.0),
    "constant": (lag([0.5]), 1.0),
    "implicit": (lag(KNOTS, solver="stiff"), 0.0),
    "sigma and delay": (lag(KNOTS[:2], data={"sigma": "noise", "delay": "late"}, parameters=NOISE_AND_DELAY), 1.0),
    "prior": (lag([1.0, 0.3], data={"loss": "cauchy"}, parameters={"b": sf.Parameter(2, prior=sf.Normal(2, 0.1))}), 0),
    "two runs": (two_lags(), 0.0),
    "transitions at knots": (transitions_at_knots(), 0.0),
}


@pytest.mark.parametrize(("problem", "power"), PROBLEMS.values(), ids=PROBLEMS)
def test_gradient_against_differences(problem, power):
    """The exact gradient by JAX, against differences of the criterion by the engine of the problem on the same mesh."""
    whole = [np.ones(len(item.times), dtype=bool) for item in problem.experiments[0].data]
    problem, d = simulate_values(problem, 0, problem.initial_theta, whole), len(problem.theta_names)
    nominal = Nominal(problem, 0, problem.initial_theta)
    rule = _build_criterion(nominal, np.arange(d), np.linspace(1.0, 2.0, d))
    table, taken = stack_inputs(problem.experiments[0]), [np.arange(len(whole[0])) % 3 > 0]

    def rate(changed):
        other = Nominal(simulate_values(replace_inputs(problem, 0, changed), 0, nominal.theta, whole), 0, nominal.theta)
        other.evaluator = Evaluator(other.problem, meshes=nominal.evaluator.meshes)
        own = other.candidates.information[taken[0]].sum(0)
        return float(rule.rate(nominal.candidates.others + own, power)[0])

    with use_float64():
        background = _describe(nominal, rule, taken)
        structure = nominal.evaluator.structures[0]
        value, slope = differentiate_criterion(table, background, structure=structure, power=power)
    assert float(value) == pytest.approx(rate(table), abs=1e-9)
    for place in list(np.ndindex(table.shape))[:6]:
        step = np.zeros_like(table)
        step[place] = 1e-4
        difference = (rate(table + step) - rate(table - step)) / 2e-4
        assert float(slope[place]) == pytest.approx(difference, rel=1e-5, abs=1e-7)


def test_a_gain_is_known_best_with_the_input_at_its_limit():
    """x' = -k x + b u with k known: what x says about b is largest with u constant at the larger limit."""
    problem = lag([0.1, -0.2, 0.3, 0.1])
    known = replace(problem, parameters={"k": sf.Parameter(0.7, fixed=True), "b": 2.0})
    plan = sf.design(known, free={"u": (-1.0, 2.0)})
    np.testing.assert_allclose(plan.inputs["u"], 2.0, rtol=1e-9)
    response = (1 - np.exp(-0.7 * TIMES[1:])) / 0.7 * 2.0
    assert plan.standard_errors[0] == pytest.approx(0.1 / np.linalg.norm(response), rel=1e-6)


@pytest.mark.parametrize("kind", ["D", "A", "E"])
def test_inputs_against_all_corners(kind):
    """No input that is at its limits everywhere is better than the design."""
    problem = lag([0.1, 0.1, 0.1, 0.1])
    plan = sf.design(problem, free={"u": (-1.0, 1.0)}, criterion=kind)
    every = (np.array([1.0, *rest])[:, None] for rest in product((-1.0, 1.0), repeat=3))
    corners = [sf.design(replace_inputs(problem, 0, each), criterion=kind).criterion_after for each in every]
    assert plan.criterion_after <= min(corners) + 1e-4 * abs(min(corners))
    assert np.all(np.abs(plan.inputs["u"]) <= 1.0)


def sunny(**settings):
    """A room with two inputs, of which the heater is free below limits of its own at each knot; three samples."""
    system = sf.HybridSystem({"on": lambda t, x, p, u: -p["k"] * x + p["b"] * u["heat"] + u["sun"]}, [0.0])
    inputs = sf.Input([0.0, 1.0, 2.0, 3.0], {"sun": [0.1] * 4, "heat": [0.5] * 4})
    data = planned(TIMES[1:], names=("T",))
    problem = sf.Problem(system, sf.Experiment(data, ("on",), (), 0.0, 4.0, inputs=inputs), {"k": 0.7, "b": 2.0})
    return problem, sf.design(problem, free={"heat": (0.0, UPPER), "sun": (0.1, 0.1)}, samples=3, **settings)


UPPER = np.array([1.0, 1.0, 0.3, 0.8])


def test_inputs_by_name_within_limits_of_each_knot_and_samples_together():
    problem, plan = sunny()
    heat = plan.inputs["heat"]
    assert np.all((heat >= 0.0) & (heat <= UPPER))
    np.testing.assert_array_equal(plan.inputs["sun"], 0.1)
    np.testing.assert_array_equal(plan.problem.experiments[0].inputs.values["heat"], heat)
    assert plan.criterion_after < sf.design(problem, samples=3).criterion_after
    assert plan.criterion_after <= sf.design(plan.problem).criterion_after + 1e-9
    np.testing.assert_array_equal(sunny()[1].inputs["heat"], heat)
    # What was designed simulates and fits.
    fit = sf.estimate(plan.problem)
    np.testing.assert_allclose(fit.theta, plan.theta, rtol=1e-6)
    np.testing.assert_allclose(fit.covariance, plan.covariance, rtol=1e-3)
    assert plan.trajectory.times[-1] == 4.0


# The result


def test_text_figure_and_file(tmp_path):
    plan = sunny(names="k", starts=1)[1]
    shown = ("D-optimal design of run1 for k.", "T: 3 of 8 samples, at ", "sun at 4 knots: 0.1, 0.1, 0.1, 0.1")
    assert all(part in str(plan) for part in (*shown, f"{plan.standard_errors[0]:.3g}"))
    assert [ax.get_ylabel() for ax in plan.plot().axes][-1] == "share of information"
    plan.save(tmp_path / "design.json")
    saved = json.loads((tmp_path / "design.json").read_text())
    assert saved["format"] == "switchfit design"
    np.testing.assert_array_equal(saved["design"]["covariance"], plan.covariance)


# Bad input

ONE_SENSOR = "sensor 1"


test_wrong_settings_of_a_line = refused(
    ({"criterion": "T"}, "criterion must be"),
    ({"names": "c"}, "names has 'c', which is no unknown of the problem: a, b"),
    ({"names": []}, "names is empty"),
    ({"names": {"a": -1.0}}, "scale of a must be positive"),
    ({"free": {"u": (0.0, 1.0)}}, "free must name inputs of the run: none; got 'u'"),
    ({"samples": 0}, "samples of sensor 1 must be"),
    ({"samples": {"X": 3}}, "samples names 'X'; the sensors are sensor 1"),
    ({"sensors": {"X": 3.0}, "budget": 1.0}, "sensors names 'X'"),
    ({"sensors": {ONE_SENSOR: 3.0}}, "budget and the costs of sensors belong together"),
    ({"sensors": 1, "budget": 2.0}, "budget and the costs of sensors belong together"),
    ({"sensors": {ONE_SENSOR: 3.0}, "budget": 2.0}, "no sensor is within the budget of 2"),
    ({"sensors": {ONE_SENSOR: -3.0}, "budget": 2.0}, "cost of sensor 1 must be positive"),
    ({"experiment": 1}, "experiment must lie in 0..0; got 1"),
    ({"theta": [1.0]}, "theta must have shape"),
    ({"starts": -1}, "starts must not be negative"),
    by=lambda settings: sf.design(line(), **settings),
    error=ValueError,
)


@pytest.mark.parametrize("limits", [(1.0, 0.0), (0.0,), 3.0, (0.0, np.inf), (np.zeros(3), 1.0), ("a", 1.0)])
def test_wrong_limits(limits):
    with pytest.raises(ValueError, match=r"free must have \(lower, upper\) for u, .* one for each of the 4 knots"):
        sf.design(lag(np.ones(4)), free={"u": limits})


ONE = lag([1.0])
COST = replace(ONE.experiments[0], data=sf.RunningCost(lambda t, x, p: x[0] ** 2))
CORNER = sf.HybridSystem({"on": lambda t, x, p, u: -p["k"] * jnp.abs(x) + p["b"] * u}, [1.0])


test_problems_that_cannot_be_designed = refused(
    (lambda: sf.design(3), TypeError, r"problem must be an sf\.Problem"),
    (lambda: sf.design(line(sigma=None)), "design needs sigma, the standard deviation of the noise, for the data"),
    (lambda: sf.design(replace(ONE, experiments=COST)), "design needs Measurements, for the data of run1"),
    (lambda: sf.design(replace(ONE, system=CORNER), free={"u": (0.0, 1.0)}), "free cannot be used where"),
    error=ValueError,
)


# --- `switchfit design`, and [design] in problem files ----------------------------------------------------------------


MODEL = """
import switchfit as sf
def heat(t, x, p, u):
    return p["b"] * u["power"] + u["sun"] - p["k"] * x
system = sf.HybridSystem({"heat": heat}, [0.0], state_names=("T",))
"""

PROBLEM = """
model = "model.py:system"
[parameters]
k = { value = 0.5, lower = 0.0 }
b = 2.0
[[experiments]]
mode_sequence = ["heat"]
inputs = { file = "plan.csv", columns = { power = "power", sun = "sun" } }
[[experiments.data]]
file = "plan.csv"
columns = ["T"]
sigma = 0.1
"""

DESIGN = """
[design]
criterion = "A"
samples = { T = 3 }
sensors = { T = 1.0 }
budget = 2.0
starts = 0
names = { k = 0.1, b = 0.5 }
free = { power = [0.0, 1.5] }
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "model.py").write_text(MODEL)
    (tmp_path / "problem.toml").write_text(PROBLEM + DESIGN)
    (tmp_path / "plain.toml").write_text(PROBLEM)
    rows = [f"{t},0,1.0,0.2" for t in np.linspace(0.0, 4.0, 9)]
    (tmp_path / "plan.csv").write_text("\n".join(["t,T,power,sun", *rows]) + "\n")
    return tmp_path


def test_a_design_is_printed_and_written(folder):
    out = folder / "out" / "deep"
    result = run("design", folder / "problem.toml", "--out", out, code=0)
    assert result.stdout.startswith("A-optimal design of run1 for k, b.\n")
    names = ["design.json", "design.png", "design.txt", "input.csv", "samples.csv"]
    assert sorted(path.name for path in out.iterdir()) == names
    assert (out / "design.txt").read_text() == result.stdout
    problem = load_problem(folder / "problem.toml").problem
    plan = sf.design(problem, **tomllib.loads(DESIGN)["design"])
    assert str(plan) == result.stdout.rstrip("\n")
    np.testing.assert_array_equal(sf.read_log(out / "input.csv")["power"], plan.inputs["power"])
    np.testing.assert_array_equal(sf.read_log(out / "input.csv").times, np.linspace(0.0, 4.0, 9))
    rows = list(csv.DictReader((out / "samples.csv").read_text().splitlines()))
    assert {row["sensor"] for row in rows} == {"T"}
    np.testing.assert_array_equal([float(row["t"]) for row in rows], plan.sample_times["T"])
    saved = json.loads((out / "design.json").read_text())["design"]
    assert saved["sample_times"]["T"] == plan.sample_times["T"].tolist()


def test_options_override_the_file(folder, monkeypatch):
    given = catch_settings(monkeypatch, "design")
    result = run("design", folder / "plain.toml", "--criterion", "E", "--samples", 5)
    assert (result.exit_code, result.stderr) == (2, "switchfit: enough\n")
    assert given == {"criterion": "E", "samples": 5}
    run("design", folder / "problem.toml", "--criterion", "D")
    assert (given["criterion"], given["samples"], given["budget"]) == ("D", {"T": 3}, 2.0)


def test_json_and_what_cannot_be_estimated(folder):
    (folder / "plan.csv").write_text((folder / "plan.csv").read_text().replace("1.0,0.2", "0.0,0.0"))
    result = run("design", folder / "plain.toml", "--json", code=1)
    assert "k, b cannot be estimated from such an experiment" in result.stderr
    shown = json.loads(result.stdout)
    assert (shown["theta_names"], shown["covariance"]) == (["k", "b"], [[None, None], [None, None]])


def test_a_mistake_in_the_file_is_said_with_its_key(folder):
    (folder / "problem.toml").write_text((PROBLEM + DESIGN).replace('criterion = "A"', 'criterion = "T"'))
    assert "design.criterion" in run("design", folder / "problem.toml", code=2).stderr
