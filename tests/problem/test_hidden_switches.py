"""Switches that a function hides are named with their line; functions that compare nothing are not."""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support import models
from switchfit.runtime.errors import HiddenSwitchError
from switchfit.uncertainty.identification import identifiability

TIMES = np.linspace(0.5, 4.0, 8)


# A switch hidden in a function


def hiding(t, x, p):
    return jnp.where(t < p["t_on"], p["k"] * (1.0 - x), -p["k"] * x)


def hidden_problem(mode=hiding, t_on=1.7):
    data = sf.Measurements(TIMES, np.exp(-TIMES), sigma=0.1)
    return models.one_run(sf.HybridSystem({"m": mode}, [0.1]), data, ("m",), (), 4.0, {"k": 1.0, "t_on": t_on})


LINE = hiding.__code__.co_firstlineno + 1
SAYS = (
    "the cost changes with t_on, but its derivative is zero at all points tried: mode 'm' compares with t_on at "
    rf"test_hidden_switches.py:{LINE}, .* make it a transition time: a mode for each side"
)


@pytest.mark.parametrize("use", [sf.estimate, partial(sf.monte_carlo, runs=2, theta=[1.0, 1.5]), identifiability])
def test_a_switch_hidden_in_a_mode_is_refused(use):
    with pytest.raises(HiddenSwitchError, match=SAYS):
        use(hidden_problem())


def smooth(t, x, p):
    """Fourth order at the guess: gradient and Hessian are zero there, and further away are not."""
    return -p["k"] * x + (p["t_on"] - 1.7) ** 4


IDLE = (lambda t, x, p: -p["k"] * x + 0.0 * p["t_on"]), 1.7


@pytest.mark.parametrize(("mode", "t_on"), [(smooth, 1.7), IDLE, (hiding, sf.Parameter(1.7, fixed=True))])
def test_a_derivative_that_is_zero_for_another_reason_is_no_hidden_switch(mode, t_on):
    """Nor is a switch that is fixed any of ours."""
    found = sf.estimate(hidden_problem(mode, t_on=t_on), strategy="local")
    assert found.status is sf.Status.SINGULAR or (mode is hiding and found.status.successful)


def test_a_hidden_switch_at_zero_is_found_between_its_bounds():
    def mode(t, x, p):
        return jnp.where(t - 1.7 < p["t_on"], 1.0 - x, -p["k"] * x)

    with pytest.raises(HiddenSwitchError, match="the cost changes with t_on, but its derivative is zero"):
        sf.estimate(hidden_problem(mode, sf.Parameter(0.0, -1.0, 1.0)))


def test_no_function_is_accused_that_does_not_compare():
    """The derivative is zero for another reason, of which nothing is known: the message says what was seen."""

    def mode(t, x, p):
        return -p["k"] * x + jnp.cos(t) * jax.lax.stop_gradient(p["t_on"])

    with pytest.raises(HiddenSwitchError, match=r"zero at all points tried, so that ((?!compares|switch).)*$"):
        sf.estimate(hidden_problem(mode))


def test_the_corner_of_a_running_cost_that_keeps_a_fit_from_converging_is_named():
    system = sf.HybridSystem({f"{a:+g}": lambda t, x, p, a=a: a * p["u"] - 0.5 * x for a in (1.0, -1.0)}, [0.0])
    cost = sf.RunningCost(lambda t, x, p: jnp.abs(x[0] - 1.0) + 0.05 * p["u"] ** 2)
    passed = sf.RunningCost(lambda t, x, p: (x[0] - 1.0) ** 2 + 1e-3 * jnp.abs(x[0] + 9.0) + 0.05 * p["u"] ** 2)
    given = {"sequence": ("+1", "-1", "+1"), "times": (2.0, 3.0), "tf": 6.0, "parameters": {"u": 1.5}}
    assert sf.estimate(models.one_run(system, passed, **given)).reason is None
    found = sf.estimate(models.one_run(system, cost, **given), strategy="local")
    line = cost.ell.__code__.co_firstlineno
    assert f"RunningCost 1 has a corner at test_hidden_switches.py:{line}" in str(found.verdict)


def make_switch_with_slope(guess, size):
    """The derivative in t_on is right between the jumps, and leads to where one of them stands in the way."""

    def mode(t, x, p):
        return jnp.where(t < p["t_on"], 0.0, p["heat"]) - 0.5 * x + size * 0.1 * (p["t_on"] - 1.7) * jnp.cos(t)

    times = np.linspace(0.1, 4.0, 40)
    heated = np.where(times < 1.7, 0.0, 2.0 * (1.0 - np.exp(-0.5 * (times - 1.7))))
    data = sf.Measurements(times, 0.2 * np.exp(-0.5 * times) + heated, sigma=0.02)
    parameters = {"t_on": sf.Parameter(guess, 0.2, 3.8), "heat": sf.Parameter(0.8, 0.1, 5.0)}
    problem = sf.Problem(sf.HybridSystem({"m": mode}, [0.2]), sf.Experiment(data, ("m",), (), 0.0, 4.0), parameters)
    return problem, mode.__code__.co_firstlineno + 1


@pytest.mark.parametrize("size", [0.1, 5.0])
@pytest.mark.parametrize("guess", [1.0, 2.2, 2.8])
def test_a_parameter_that_is_a_switch_and_smooth_as_well_is_named_in_the_verdict(guess, size):
    problem, line = make_switch_with_slope(guess, size)
    best, found = sf.estimate(problem), sf.estimate(problem, strategy="local")
    assert best.cost < 150.0  # 1924 where the line search failed first: searches go on from there
    assert best.verdict.level != "good"
    assert f"mode 'm' compares with t_on at test_hidden_switches.py:{line}" in str(best.verdict)
    if found.status is sf.Status.LINE_SEARCH_FAILED:
        place = re.search(r"where the cost jumps, at t_on = (\S+); .*mode 'm' compares", str(found.verdict))
        assert float(place[1]) == pytest.approx(found.theta[0], abs=1e-3)
        assert str(found.verdict).endswith(": make t_on a transition time if it is one, or use a smooth function.")
        assert re.search(r"passes \S+: mode 'm' compares with t_on", found.message)


@pytest.mark.parametrize(
    ("mode", "tolerance"),
    [
        (models.decay, 1e-11),  # a perfect fit: J is 1e-20, rounding alone, and its integration error is all of it
        pytest.param(lambda t, x, p: -p["k"] * x + jnp.cos(60.0 * p["k"] * t), 1e-2, marks=pytest.mark.slow),
    ],
    ids=["perfect", "coarse"],
)
def test_an_integration_error_that_stays_large_for_another_reason_accuses_no_function(mode, tolerance):
    run = sf.Experiment(sf.Measurements(TIMES, np.exp(-TIMES), sigma=0.1), ("m",), (), 0.0, 4.0)
    problem = sf.Problem(sf.HybridSystem({"m": mode}, [1.0]), run, {"k": 1.0}, rtol=tolerance, atol=tolerance)
    found = sf.estimate(problem, start=[1.0])
    assert found.cost < 1e-15 or found.certificate.integration_error > 1e-4
    assert found.reason is None
