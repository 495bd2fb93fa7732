"""Inputs whose entries have names: a model that reads ``u["left"]`` against the same one that reads ``u[0]``."""

import cloudpickle
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import switchfit as sf
from support.models import one_run, refused

TIMES = np.linspace(0.0, 3.0, 31)
SAMPLES = np.linspace(0.0, 3.0, 7)
RNG = np.random.default_rng(5)
LEFT, RIGHT = RNG.normal(size=(2, 7))
VALUES = np.stack([np.sin(TIMES), 0.3 * np.cos(TIMES)], axis=1)
NAMED, ARRAY = {"right": RIGHT, "left": LEFT}, np.stack([LEFT, RIGHT], axis=1)


def system_of(left, right):
    """Two modes that are driven by two inputs, found under the keys `left` and `right`."""

    def pull(t, x, p, u):
        return jnp.array([x[1], u[left] - p["k"] * x[0]])

    def slip(t, x, p, u):
        return jnp.array([x[1] * u[right], -p["k"] * x[1] + u[left] * u[right]])

    return sf.HybridSystem({"pull": pull, "slip": slip}, [sf.Parameter(0.4), 0.1], state_names=("x", "v"))


BY_NAME, BY_POSITION = system_of("left", "right"), system_of(0, 1)


def problem_of(system, values, kind="linear", engine="auto"):
    log = sf.Measurements(TIMES[1:-1], VALUES[1:-1], sigma=0.1)
    inputs = sf.Input(SAMPLES, values, kind=kind)
    return one_run(system, log, ("pull", "slip"), (1.234,), 3.0, {"k": 1.1}, inputs=inputs, engine=engine)


def both(**settings):
    """The problem with names and the same one with positions."""
    return problem_of(BY_NAME, NAMED, **settings), problem_of(BY_POSITION, ARRAY, **settings)


@pytest.mark.parametrize("kind", ["hold", "linear", "cubic"])
@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_names_and_positions_agree_to_the_bit(engine, kind):
    named, plain = both(engine=engine, kind=kind)
    one, other = (sf.evaluate(problem) for problem in (named, plain))
    assert one.cost == other.cost
    np.testing.assert_array_equal(one.gradient, other.gradient)
    # XLA fuses the sums of the two programs in another order: the last bit of a second derivative may differ.
    np.testing.assert_allclose(one.hessian, other.hessian, rtol=1e-14 if engine == "jax" else 0.0)
    np.testing.assert_array_equal(sf.simulate(named).states, sf.simulate(plain).states)
    # The inputs do act: exchanged, the cost is another one.
    exchanged = problem_of(BY_NAME, {"left": RIGHT, "right": LEFT}, engine=engine, kind=kind)
    assert abs(sf.evaluate(exchanged).cost - one.cost) > 1e-3


def test_a_problem_with_names_is_checked_and_travels():
    """By the paper's equations, and to another process."""
    named, _ = both()
    assert sf.check_derivatives(named).passed
    again = cloudpickle.loads(cloudpickle.dumps(named))
    assert again.experiments[0].inputs.names == ("left", "right")
    assert again.structures == named.structures


def test_the_order_of_the_names_does_not_count_and_other_names_are_another_function():
    one = problem_of(BY_NAME, {"left": LEFT, "right": RIGHT})
    other = problem_of(BY_NAME, {"right": RIGHT, "left": LEFT})
    assert one.structures == other.structures
    assert sf.evaluate(one).cost == sf.evaluate(other).cost

    def fall(t, x, p, u):
        assert type(u) is dict, "which JAX can take apart"
        return p["k"] * (2.0 * u["a"] if "a" in u else u["b"]) * x

    system, cost = sf.HybridSystem({"fall": fall}, [1.0]), sf.TerminalCost(lambda x, p: x[0])
    for name, rate in (("a", 2.0), ("b", 1.0)):
        run = sf.Experiment(cost, ("fall",), (), 0.0, 1.0, inputs=sf.Input([0.0], {name: [1.0]}))
        assert sf.evaluate(sf.Problem(system, run, {"k": 1.0})).cost == pytest.approx(np.exp(rate), rel=1e-8)


def test_values_are_kept_by_name_and_cannot_be_changed():
    inputs = sf.Input(SAMPLES, NAMED)
    assert (inputs.names, inputs.shape) == (("left", "right"), (2,))
    assert inputs.values["left"][0] == LEFT[0]
    with pytest.raises(ValueError, match="read-only"):
        inputs.values["left"][0] = 1.0
    assert (sf.Input([0.0], [1.0]).shape, sf.Input([0.0], [[1.0, 2.0]]).shape) == ((), (2,))


def test_columns_of_a_data_frame():
    """By their names if these are strings, by position otherwise."""
    named, plain = (sf.Input(SAMPLES, pd.DataFrame(columns)) for columns in (NAMED, {0: LEFT, 1: RIGHT}))
    assert (named.names, plain.names) == (("left", "right"), ())
    np.testing.assert_array_equal(named.values["left"], LEFT)
    np.testing.assert_array_equal(plain.values, ARRAY)


test_bad_values = refused(
    ({}, ValueError, "Input values must have a name for each entry of u, .*; got an empty dict"),
    ({"a": SAMPLES, "b": SAMPLES[:3]}, ValueError, r"Input 'b' needs .* got \(7,\) and \(3,\)"),
    ({"a": np.ones((7, 2))}, ValueError, r"Input 'a' needs .* values of shape \(K,\); got \(7,\) and \(7, 2\)"),
    by=lambda values: sf.Input(SAMPLES, values),
)


test_modes_that_ask_for_what_is_not_there = refused(
    ((system_of("k", "right"), NAMED), "mode 'pull' reads 'k', which is not there: p has k; u has left, right"),
    ((system_of("left", 1), np.ones((7, 2))), r"mode 'pull'.* u has no names: give sf.Input a dict of name -> samples"),
    by=lambda given: problem_of(*given),
    error=ValueError,
)
