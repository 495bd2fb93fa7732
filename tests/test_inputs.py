"""Inputs whose entries have names: a model that reads ``u["left"]`` against the same one that reads ``u[0]``."""

import cloudpickle
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import switchfit as sf
from switchfit.io.problem_file import load_problem

TIMES = np.linspace(0.0, 3.0, 31)
SAMPLES = np.linspace(0.0, 3.0, 7)
RNG = np.random.default_rng(5)
LEFT, RIGHT = RNG.normal(size=(2, 7))
VALUES = np.stack([np.sin(TIMES), 0.3 * np.cos(TIMES)], axis=1)
NAMED = {"right": RIGHT, "left": LEFT}


def system_of(left, right):
    """Two modes that are driven by two inputs, found under the keys `left` and `right`."""

    def pull(t, x, p, u):
        return jnp.array([x[1], u[left] - p["k"] * x[0]])

    def slip(t, x, p, u):
        return jnp.array([x[1] * u[right], -p["k"] * x[1] + u[left] * u[right]])

    return sf.HybridSystem({"pull": pull, "slip": slip}, [sf.Parameter(0.4), 0.1], state_names=("x", "v"))


BY_NAME, BY_POSITION = system_of("left", "right"), system_of(0, 1)


def problem_of(system, values, kind="linear", engine="auto", data=VALUES):
    log = sf.Measurements(TIMES[1:-1], data[1:-1], sigma=0.1)
    inputs = sf.Input(SAMPLES, values, kind=kind)
    run = sf.Experiment(log, ("pull", "slip"), (1.234,), 0.0, 3.0, inputs=inputs)
    return sf.Problem(system, run, {"k": 1.1}, engine=engine)


def both(**settings):
    """The problem with names and the same one with positions."""
    array = np.stack([LEFT, RIGHT], axis=1)
    return problem_of(BY_NAME, NAMED, **settings), problem_of(BY_POSITION, array, **settings)


@pytest.mark.parametrize(
    ("engine", "kind"),
    [
        *(("native", kind) for kind in ("hold", "linear", "cubic")),
        *(pytest.param("jax", kind, marks=pytest.mark.slow) for kind in ("hold", "linear", "cubic")),
    ],
)
def test_names_and_positions_agree_to_the_bit(engine, kind):
    """The paper's equations, too, which the next test checks by default, in the slow tests alone."""
    named, plain = both(engine=engine, kind=kind)
    for method in ("auto", "adjoint") if (engine, kind) == ("jax", "hold") else ("auto",):
        one, other = (sf.evaluate(problem, method=method) for problem in (named, plain))
        assert one.cost == other.cost
        np.testing.assert_array_equal(one.gradient, other.gradient)
        np.testing.assert_array_equal(one.hessian, other.hessian)
        assert np.abs(one.gradient).min() > 1e-6
    paths = [sf.simulate(problem) for problem in (named, plain)]
    np.testing.assert_array_equal(paths[0].states, paths[1].states)
    # The inputs do act: exchanged, the cost is another one.
    exchanged = problem_of(BY_NAME, {"left": RIGHT, "right": LEFT}, engine=engine, kind=kind)
    assert abs(sf.evaluate(exchanged).cost - sf.evaluate(named).cost) > 1e-3


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
        return p["k"] * (2.0 * u["a"] if "a" in u else u["b"]) * x

    system, cost = sf.HybridSystem({"fall": fall}, [1.0]), sf.TerminalCost(lambda x, p: x[0])
    for name, rate in (("a", 2.0), ("b", 1.0)):
        run = sf.Experiment(cost, ("fall",), (), 0.0, 1.0, inputs=sf.Input([0.0], {name: [1.0]}))
        assert sf.evaluate(sf.Problem(system, run, {"k": 1.0})).cost == pytest.approx(np.exp(rate), rel=1e-8)


def test_u_is_a_dict_that_jax_knows():
    """It can be handed to what is jitted, mapped over and taken apart."""

    @jax.jit
    def force(u):
        return u["left"] + u["right"]

    def pull(t, x, p, u):
        assert type(u) is dict
        assert {entry.shape for entry in u.values()} == {()}
        return jnp.array([x[1], force(u) - p["k"] * x[0] + 0.0 * sum(jax.tree.leaves(u))])

    system = sf.HybridSystem({"pull": pull, "slip": pull}, [1.0, 0.0])
    plain = sf.HybridSystem(
        dict.fromkeys(("pull", "slip"), lambda t, x, p, u: jnp.array([x[1], u[0] + u[1] - p["k"] * x[0]])), [1.0, 0.0]
    )
    found = sf.evaluate(problem_of(system, NAMED)).cost
    assert found == pytest.approx(sf.evaluate(problem_of(plain, np.stack([LEFT, RIGHT], axis=1))).cost, rel=1e-13)


def test_values_are_kept_by_name_and_cannot_be_changed():
    left = LEFT.copy()
    inputs = sf.Input(SAMPLES, {"right": RIGHT, "left": left})
    left[0] = 9.0
    assert (inputs.names, inputs.shape) == (("left", "right"), (2,))
    assert inputs.values["left"][0] == LEFT[0]
    with pytest.raises(ValueError, match="read-only"):
        inputs.values["left"][0] = 1.0
    assert (sf.Input([0.0], [1.0]).shape, sf.Input([0.0], [[1.0, 2.0]]).shape) == ((), (2,))


def test_columns_of_a_data_frame():
    """By their names if these are strings, by position otherwise."""
    named = sf.Input(SAMPLES, pd.DataFrame(NAMED))
    assert named.names == ("left", "right")
    np.testing.assert_array_equal(named.values["left"], LEFT)
    plain = sf.Input(SAMPLES, pd.DataFrame({0: LEFT, 1: RIGHT}))
    assert plain.names == ()
    np.testing.assert_array_equal(plain.values, np.stack([LEFT, RIGHT], axis=1))


@pytest.mark.parametrize(
    ("values", "error", "message"),
    [
        ({}, ValueError, "Input values must have a name for each entry of u, .*; got an empty dict"),
        ({1: SAMPLES}, TypeError, "names in Input values must be strings; got 1"),
        ({"": SAMPLES}, ValueError, "names in Input values must not be empty"),
        ({"a": SAMPLES, "b": SAMPLES[:3]}, ValueError, r"Input 'b' needs .* got \(7,\) and \(3,\)"),
        ({"a": 1.0}, ValueError, r"Input 'a' needs times .* and values of shape \(K,\); got \(7,\) and \(\)"),
        ({"a": np.ones((7, 2))}, ValueError, r"Input 'a' needs .* values of shape \(K,\); got \(7,\) and \(7, 2\)"),
        ({"a": SAMPLES, "b": [np.nan, *SAMPLES[1:]]}, ValueError, r"Input 'b' values must be finite; got nan at index"),
        ({"a": ["x"] * 7}, ValueError, "Input 'a' values must be an array of numbers"),
    ],
)  # fmt: skip
def test_bad_values(values, error, message):
    with pytest.raises(error, match=message):
        sf.Input(SAMPLES, values)


@pytest.mark.parametrize(
    ("left", "values", "message"),
    [
        ("k", NAMED, "mode 'pull' reads 'k', which is not there: p has k; u has left, right"),
        (0, NAMED, "reads 0, which is not there: p has k; u has left, right"),
        ("left", np.ones((7, 2)), r"mode 'pull'.* u has no names: give sf.Input a dict of name -> samples"),
    ],
)
def test_modes_that_ask_for_what_is_not_there(left, values, message):
    with pytest.raises(ValueError, match=message):
        problem_of(system_of(left, "right" if isinstance(values, dict) else 1), values)


MODEL = """
import jax.numpy as jnp
import switchfit as sf

def pull(t, x, p, u):
    return jnp.array([x[1], u["left"] * u["right"] - p["k"] * x[0]])

system = sf.HybridSystem({"pull": pull}, [1.0, 0.0], state_names=("x", "v"))
"""

COLUMNS = '{ left = "wheel 1", right = "wheel 2" }'
FILE = f"""
model = "model.py:system"
[parameters]
k = 1.1
[[experiments]]
mode_sequence = ["pull"]
transition_times = []
[[experiments.data]]
file = "log.csv"
time = "t"
columns = ["x"]
observe = ["x"]
sigma = 0.1
[experiments.inputs]
file = "log.csv"
time = "t"
kind = "linear"
columns = {COLUMNS}
"""


@pytest.fixture
def folder(tmp_path):
    rows = [f"{t},{x},{a},{b}" for t, x, a, b in zip(SAMPLES, np.cos(SAMPLES), LEFT, RIGHT, strict=True)]
    (tmp_path / "log.csv").write_text("\n".join(["t,x,wheel 1,wheel 2", *rows]))
    (tmp_path / "model.py").write_text(MODEL)
    (tmp_path / "problem.toml").write_text(FILE)
    return tmp_path


def test_names_in_a_problem_file(folder):
    inputs = load_problem(folder / "problem.toml").problem.experiments[0].inputs
    assert inputs.names == ("left", "right")
    np.testing.assert_array_equal(inputs.values["left"], LEFT)
    np.testing.assert_array_equal(inputs.values["right"], RIGHT)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('right = "wheel 2"', 'right = "wheel 3"', "has no column 'wheel 3'; its columns are t, x, wheel 1, wheel 2"),
        ('right = "wheel 2"', 'rigth = "wheel 2"', "reads 'right', which is not there: .*; u has left, rigth"),
        ('right = "wheel 2"', "right = 2", "'experiments.1..inputs.columns' must be a string; got 2"),
        (COLUMNS, "{}", "'experiments.1..inputs.columns' must have at least 1 item"),
    ],
)
def test_names_in_a_problem_file_that_are_wrong(folder, old, new, message):
    (folder / "problem.toml").write_text(FILE.replace(old, new))
    with pytest.raises(ValueError, match=message):
        load_problem(folder / "problem.toml")
