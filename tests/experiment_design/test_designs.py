"""Designs of samples, sensors and inputs, against closed forms and brute force; what is refused."""

import json
from dataclasses import replace
from itertools import combinations, product

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.designs import TIMES, lag, line, line_information, planned
from support.models import STILL, decay, refused
from switchfit.experiment_design.input_search import _describe, differentiate_criterion
from switchfit.experiment_design.inputs import replace_inputs, stack_inputs
from switchfit.experiment_design.nominal import Nominal, simulate_values
from switchfit.experiment_design.samples import Candidates, choose_samples
from switchfit.experiment_design.search import _build_criterion
from switchfit.meshes.evaluator import Evaluator
from switchfit.problem.functions import use_float64


def decaying(times, **parameters):
    """x = start exp(-k t), with k = 0.5."""
    system = sf.HybridSystem({"decay": decay}, lambda p: jnp.stack([p["start"]]))
    return sf.Problem(system, sf.Experiment(planned(times), ("decay",), (), 0.0, 8.0), {"k": 0.5} | parameters)


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
