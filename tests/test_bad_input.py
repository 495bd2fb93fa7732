"""Every `raise` that a user can reach: the message names the thing, says what was given and what to do."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import decay, first_state

import switchfit as sf
from switchfit.discretization.model import Model
from switchfit.problem.functions import Call, call_for_vector, use_float64


def grow(t, x, p):
    return p["k"] * x


TIMES = np.linspace(0.0, 1.0, 5)
SAMPLES = sf.Measurements(TIMES, np.ones(5), observe=first_state, sigma=0.1)


def system(**changes):
    given = {"modes": {"grow": grow, "shrink": decay}, "initial_state": [1.0]}
    return sf.HybridSystem(**(given | changes))


def experiment(**changes):
    given = {"data": SAMPLES, "mode_sequence": ("grow", "shrink"), "transition_times": (0.4,), "t0": 0.0, "tf": 1.0}
    return sf.Experiment(**(given | changes))


def three_modes(times, **changes):
    return experiment(mode_sequence=("grow", "shrink", "grow"), transition_times=times, **changes)


def problem(run=None, of=None, parameters=None, **settings):
    return sf.Problem(
        system() if of is None else of,
        experiment() if run is None else run,
        {"k": 1.0} if parameters is None else parameters,
        **settings,
    )


def with_mode(mode, **changes):
    """A problem in which the mode "grow" is replaced."""
    return problem(of=system(modes={"grow": mode, "shrink": decay}, **changes))


def reference(times=TIMES, values=TIMES, **settings):
    return sf.ReferenceSignal.from_samples(times, values, **settings)


def samples(times=(0.5,), values=(1.0,), **settings):
    return sf.Measurements(times, values, **settings)


def refused(build, error, *said):
    """`build` raises `error`, and the message contains every one of the pieces `said`."""
    with pytest.raises(error) as caught:
        build()
    message = str(caught.value)
    for piece in said:
        assert piece in message, f"{piece!r} is missing in: {message}"
    assert message.endswith("."), f"not a sentence: {message}"


# Systems


@pytest.mark.parametrize(
    ("changes", "error", "said"),
    [
        ({"modes": {}}, ValueError, ["modes must be a non-empty dict", "got {}"]),
        ({"modes": {1: grow}}, TypeError, ["mode names must be strings; got 1"]),
        ({"modes": {"grow": 3}}, TypeError, ["mode 'grow' must be a function f(t, x, p); got int"]),
        ({"initial_state": "a"}, ValueError, ["initial_state must be an array of numbers", "got 'a'"]),
        ({"initial_state": []}, ValueError, ["initial_state must have shape (n,)", "got shape (0,)"]),
        ({"initial_state": [math.nan]}, ValueError, ["initial_state must be finite; got [nan]"]),
        ({"reset_maps": [grow]}, TypeError, ["reset_maps must be a dict of (mode before, mode after) -> function"]),
        ({"reset_maps": {"grow": grow}}, ValueError, ["keys (mode before, mode after); got 'grow'"]),
        ({"reset_maps": {("grow", "fall"): grow}}, ValueError, ["reset_maps names the unknown mode 'fall'; the modes"]),
        ({"reset_maps": {("grow", "shrink"): 1}}, TypeError, ["reset map ('grow', 'shrink') must be a function"]),
        ({"state_names": "x"}, TypeError, ["state_names must be a sequence of strings", "the string 'x'"]),
        ({"state_names": ("x", "y")}, ValueError, ["state_names must have one entry for each of the 1 states; got 2"]),
    ],
)
def test_system(changes, error, said):
    refused(lambda: system(**changes), error, *said)


def test_state_names_are_counted_where_the_initial_state_is_a_function():
    labelled = system(initial_state=lambda p: jnp.array([p["k"]]), state_names=("x", "y"))
    refused(lambda: problem(of=labelled), ValueError, "state_names must have one entry for each of the 1 states; got 2")


# Data


@pytest.mark.parametrize(
    ("build", "error", "said"),
    [
        (lambda: samples([0.0, 0.0], [1.0, 2.0]), ValueError, ["must increase strictly; got 0.0 followed by 0.0"]),
        (lambda: samples([0.0, 1.0], [1.0]), ValueError, ["one row of values for each time; got 2 times, 1 rows"]),
        (lambda: samples([], []), ValueError, ["Measurements needs 1 sample(s) or more; got 0"]),
        (lambda: samples([], np.empty((0, 0))), ValueError, ["Measurements needs 1 sample(s) or more; got 0"]),
        (lambda: samples([], np.empty((0, 2)), sigma=np.empty((0, 2))), ValueError, ["sigma must be", "shape (2,)"]),
        (lambda: samples([math.nan], [1.0]), ValueError, ["Measurements times must be finite; got nan at index [0]"]),
        (lambda: samples("a", "b"), ValueError, ["Measurements times must be a number or a date; got 'a'"]),
        (lambda: samples([0.0], [[[1.0]]]), ValueError, ["values of shape (K,) or (K, q)", "(1,) and (1, 1, 1)"]),
        (lambda: samples([0.0], [math.inf]), ValueError, ["must be finite, or NaN where a sample is missing"]),
        (lambda: samples([0.0], [math.nan]), ValueError, ["Measurements values are all NaN: there is nothing to fit"]),
        (lambda: samples(observe=3), TypeError, ["observe must be a function h(t, x, p); got int"]),
        (lambda: samples(sigma=0.0), ValueError, ["sigma must be positive and finite", "0.0"]),
        (lambda: samples(sigma={"x": 1}), TypeError, ["sigma must be a number or an array of numbers; got {'x': 1}"]),
        (lambda: samples(sigma=[1.0, 2.0]), ValueError, ["sigma must be", "of shape (1,) (one per channel)", "(2,)"]),
        (lambda: samples(names=("a", "b")), ValueError, ["names must have one entry for each of the 1 channels"]),
        (lambda: sf.Input([0.0], [1.0], kind="step"), ValueError, ["'hold', 'linear' or 'cubic'; got 'step'"]),
        (lambda: sf.Input([0, 1, 2], [1, 2, 3], kind="cubic"), ValueError, ["Input needs 4 sample(s) or more; got 3"]),
        (lambda: sf.Input([0.0], [math.nan]), ValueError, ["Input values must be finite; got nan at index [0]"]),
        (lambda: sf.RunningCost(3), TypeError, ["RunningCost must be a function ell(t, x, p); got int"]),
        (lambda: sf.TerminalCost(3), TypeError, ["TerminalCost must be a function phi(x, p); got int"]),
        (lambda: sf.ReferenceSignal(TIMES), TypeError, ["by sf.ReferenceSignal.from_samples(times, values, ...)"]),
        (lambda: reference([0, 1, 2], [1, 2, 3]), ValueError, ["ReferenceSignal needs 4 sample(s) or more; got 3"]),
        (lambda: reference([0, 1, 2, 2, 3], [1, 2, 3, 4, 5]), ValueError, ["four samples or more in each channel and"]),
        (lambda: reference([0, 1, 2, 3], [1, math.nan, 2, 3]), ValueError, ["four samples or more in each channel"]),
        (lambda: reference(values=[1, 2, math.inf, 4, 5]), ValueError, ["must be finite, or NaN", "got infinity"]),
        (lambda: reference(lowpass_hz=0), ValueError, ["lowpass_hz must be positive; got 0"]),
        (lambda: reference(weights=[1.0, 2.0]), ValueError, ["weights must have shape (1,) or (1, 1); got (2,)"]),
        (
            lambda: reference(values=np.zeros((5, 2)), weights=[[1.0, 2.0], [0.0, 1.0]]),
            ValueError,
            ["weights must be finite and symmetric", "2.0"],
        ),
        (lambda: reference(weights=[-1.0]), ValueError, ["positive semi-definite; its smallest eigenvalue is -1"]),
    ],
)
def test_data(build, error, said):
    refused(build, error, *said)


# Parameters and experiments


@pytest.mark.parametrize(
    ("build", "said"),
    [
        (lambda: sf.Parameter("a"), ["Parameter value must be a number or a date; got 'a'"]),
        (lambda: sf.Parameter([1.0, 2.0], lower=[1, 2, 3]), ["Parameter needs numbers", "lower [1.0, 2.0, 3.0]"]),
        (lambda: sf.Parameter([]), ["Parameter value must have one entry or more"]),
        (lambda: sf.Parameter(math.nan), ["Parameter value must be finite; got nan"]),
        (lambda: sf.Parameter(1.5, lower=2.0, upper=1.0), ["lower <= upper; got [2.0, 1.0]"]),
        (lambda: sf.Parameter(3.0, lower=1.0, upper=2.0), ["value 3.0 lies outside its bounds [1.0, 2.0]"]),
    ],
)
def test_parameter(build, said):
    refused(build, ValueError, *said)


@pytest.mark.parametrize(
    ("changes", "error", "said"),
    [
        ({"t0": 1.0, "tf": 0.0}, ValueError, ["finite horizon with t0 < tf; got (1.0, 0.0)"]),
        ({"tf": "end"}, ValueError, ["tf must be a number", "got 'end'"]),
        ({"t0": [0.0, 1.0]}, ValueError, ["t0 must be a single number; got [0.0, 1.0]"]),
        ({"mode_sequence": "grow"}, TypeError, ["mode_sequence must be a sequence of mode names; got the string"]),
        ({"mode_sequence": ()}, ValueError, ["mode_sequence is empty; name at least one mode"]),
        ({"transition_times": ()}, ValueError, ["one fewer than the 2 modes", "got 0, needed 1"]),
        ({"transition_times": (1.5,)}, ValueError, ["increase strictly inside (t0, tf) = (0.0, 1.0); got [1.5]"]),
        ({"transition_times": (math.nan,)}, ValueError, ["a transition time must be a number", "got nan"]),
        ({"transition_times": [None]}, TypeError, ["a transition time must be a number", "None"]),
        ({"transition_times": ([0.1, 0.2],)}, ValueError, ["transition_times must be single numbers", "[(2,)]"]),
        ({"inputs": 3}, TypeError, ["inputs must be an sf.Input; got int"]),
        (
            {"inputs": sf.Input([0.0, 0.5], [1.0, 2.0], kind="linear")},
            ValueError,
            ["Input must be known over (t0, tf) = (0.0, 1.0); its samples reach from 0.0 to 0.5"],
        ),
        ({"initial_state": [math.nan]}, ValueError, ["initial_state must be finite; got [nan]"]),
        ({"data": [SAMPLES, 3]}, TypeError, ["data must be sf.Measurements", "or a list of them; got int"]),
        ({"data": []}, ValueError, ["data is empty: an experiment needs at least one cost"]),
        (
            {"data": samples([-1.0, 0.5, 2.0], [1.0, 1.0, 1.0])},
            ValueError,
            ["Measurements times must lie inside [t0, tf] = [0.0, 1.0]; 2 of 3 do not, the first is -1.0"],
        ),
        (
            {"data": reference([0, 0.1, 0.2, 0.3], [1, 2, 3, 4])},
            ValueError,
            ["A ReferenceSignal must reach over (t0, tf) = (0.0, 1.0); this one is known from 0.0 to 0.3", "Give t0"],
        ),
        (
            {"data": sf.RunningCost(lambda t, x, p: x[0]), "t0": None, "tf": None},
            ValueError,
            ["t0 and tf are left out, but nothing among the data (RunningCost) has times", "give t0 and tf."],
        ),
        (
            {"data": sf.TerminalCost(lambda x, p: x[0]), "tf": None},
            ValueError,
            ["tf is left out, but nothing among the data (TerminalCost) has times", "give tf."],
        ),
        (
            {"data": samples(), "t0": None, "tf": None},
            ValueError,
            ["t0 and tf are left out", "t0 < tf; got (0.5, 0.5)", "taken from the data: give it"],
        ),
        ({"t0": 2.0, "tf": None}, ValueError, ["tf is left out", "t0 < tf; got (2.0, 1.0)"]),
        (
            {"t0": None, "tf": sf.Parameter(-1.0, upper=2.0)},
            ValueError,
            ["t0 is left out", "t0 < tf; got (0.0, -1.0)"],
        ),
        (
            {"data": [samples([0.0, 2.0], [1, 1]), reference([0, 0.5, 1, 1.5], [1, 1, 1, 1])], "tf": None},
            ValueError,
            ["A ReferenceSignal must reach over (t0, tf) = (0.0, 2.0)", "Give t0 and tf inside that"],
        ),
    ],
)
def test_experiment(changes, error, said):
    refused(lambda: experiment(**changes), error, *said)


@pytest.mark.parametrize("times", [(0.5, 0.2), (0.5, 0.5)])
def test_transition_times_out_of_order(times):
    refused(lambda: three_modes(times), ValueError, "transition_times must increase strictly", f"got {list(times)}")


def test_ragged_transition_times():
    refused(lambda: three_modes([[0.5, 0.6], 0.7]), ValueError, "transition_times must be single numbers", "(2,), ()")


# Problems


FIXED = sf.Parameter(0.4, fixed=True)


@pytest.mark.parametrize(
    ("build", "error", "said"),
    [
        (lambda: problem(of=3), TypeError, ["system must be an sf.HybridSystem; got int"]),
        (lambda: problem([]), TypeError, ["experiments must be an sf.Experiment or a non-empty list of them; got []"]),
        (
            lambda: problem(experiment(mode_sequence=("grow", "fall"))),
            ValueError,
            ["mode_sequence names the unknown mode 'fall'; the modes are grow, shrink"],
        ),
        (lambda: problem(solver="euler"), ValueError, ["solver must be 'auto', 'explicit' or 'stiff'; got 'euler'"]),
        (lambda: problem(rtol=0), ValueError, ["rtol must be positive; got 0.0"]),
        (lambda: problem(rtol=1e-16), ValueError, ["rtol must lie between 1e-13", "got 1e-16"]),
        (lambda: problem(atol=-1.0), ValueError, ["atol must be positive; got -1.0"]),
        (lambda: problem(parameters=["k"]), TypeError, ["parameters must be a dict of name -> value", "got ['k']"]),
        (lambda: problem(parameters={"k": 1.0, 1: 2.0}), TypeError, ["parameter names must be strings; got 1"]),
        (lambda: problem(parameters={"k": "x"}), ValueError, ["parameter 'k' must be a number, an array or an sf."]),
        (
            lambda: problem(experiment(transition_times=(FIXED,)), parameters={"k": sf.Parameter(1.0, fixed=True)}),
            ValueError,
            ["Nothing to estimate: every parameter and transition time is fixed"],
        ),
        (lambda: problem(parameters={"k": 1.0, "tau_1": 1.0}), ValueError, ["Two unknowns share a name: tau_1"]),
        (lambda: problem(min_duration=0.5), ValueError, ["min_duration is 0.5 s, but the guess gives mode 1 ('grow')"]),
        (
            lambda: problem([experiment(), three_modes((0.4, 0.6))], min_duration=0.3),
            ValueError,
            ["min_duration is 0.3 s, but the guess gives mode 2 ('shrink') of run2 only 0.2 s"],
        ),
        (lambda: problem(min_duration=-0.5), ValueError, ["min_duration must be zero or positive; got -0.5"]),
        (
            lambda: problem([experiment(name="long", initial_state=[1.0, 2.0])]),
            ValueError,
            ["initial_state of experiment long must have 1 entries, as the system's has; got 2"],
        ),
        (
            lambda: problem(experiment(data=samples([0.5], [[1.0, 2.0]]))),
            ValueError,
            ["Without observe the whole state is compared: its 1 entries", "got 2. Give observe=h(t, x, p) -> (2,)"],
        ),
    ],
)
def test_problem(build, error, said):
    refused(build, error, *said)


def branching(t, x, p):
    return x if x[0] > 0 else -x


def loud(t, x, p):
    raise AssertionError("not here")


@pytest.mark.parametrize(
    ("mode", "said"),
    [
        (lambda t, x, p: jnp.zeros(2), ["f(t, x, p) must return an array of shape (1,); got shape (2,)"]),
        (lambda t, x, p: x.astype(jnp.float32), ["must return float64; got float32", "do not cast them"]),
        pytest.param(lambda t, x, p: x * 1j, ["must return float64; got complex128"], marks=pytest.mark.promotes),
        (lambda t, x, p: None, ["must return an array of numbers; got None"]),
        (lambda t, x, p: [x, [x, x]], ["must return an array of numbers; got [JitTracer"]),
        (branching, ["branches on the value of t, x or p (an `if`", "make it a mode with a transition time"]),
        (lambda t, x, p: math.sin(x[0]) * x, ["branches on the value of t, x or p", "Write it with jax.numpy"]),
        (lambda t, x, p: np.array([x[0]]), ["branches on the value of t, x or p", "numpy function"]),
        (lambda t, x, p: np.arange(3.0)[t] * x, ["branches on the value of t, x or p"]),
        (lambda t, x, p: p["q"] * x, ["reads the parameter 'q', which the problem lacks; it has k"]),
        (lambda t, x: x, ["is called as f(t, x, p), but takes the arguments (t, x)"]),
        (lambda t, x, p: x.velocity, ["f(t, x, p) raised AttributeError", "velocity"]),
        (lambda t, x, p: np.ones(3) + np.ones(2), ["f(t, x, p) raised ValueError: operands could not be broadcast"]),
        (loud, ["f(t, x, p) raised AssertionError: not here"]),
    ],
)
def test_vector_field(mode, said):
    refused(lambda: with_mode(mode), ValueError, "mode 'grow'", *said)


def test_a_vector_field_gets_inputs_only_where_there_are_any():
    driven = experiment(inputs=sf.Input([0.0], [1.0]))
    refused(
        lambda: problem(driven),
        ValueError,
        "mode 'grow' is called as f(t, x, p, u), but takes the arguments (t, x, p). Modes get",
    )


def test_a_scalar_is_not_taken_for_a_state_of_two():
    two = system(modes={"grow": lambda t, x, p: x[0], "shrink": decay}, initial_state=[1.0, 2.0])
    refused(lambda: problem(of=two), ValueError, "mode 'grow'", "shape (2,); got shape ()")


@pytest.mark.parametrize(
    ("reset", "said"),
    [
        (lambda t, x, p: jnp.zeros(2), ["R(t, x, p) must return an array of shape (1,); got shape (2,)"]),
    ],
)
def test_reset_map(reset, said):
    resetting = system(reset_maps={("grow", "shrink"): reset})
    refused(lambda: problem(of=resetting), ValueError, "reset map ('grow', 'shrink')", *said)


@pytest.mark.parametrize(
    ("initial", "said"),
    [
        (lambda p: jnp.zeros((2, 2)), ["initial_state(p) must return an array of shape (n,); got shape (2, 2)"]),
        (lambda p: p["k"], ["initial_state(p) must return an array of shape (n,); got shape ()"]),
        (lambda p: [p["k"] if p["k"] > 0 else 1.0], ["initial_state branches on the value of t, x or p"]),
        (lambda: [1.0], ["is called as initial_state(p), but takes the arguments ()"]),
    ],
)
def test_initial_state_as_a_function(initial, said):
    refused(lambda: problem(of=system(initial_state=initial)), ValueError, *said)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (samples(observe=lambda t, x, p: jnp.zeros(2)), ["observe: h(t, x, p)", "shape (1,); got shape (2,)"]),
        (reference(observe=lambda t, x, p: [p["q"]]), ["observe reads the parameter 'q'"]),
        (sf.RunningCost(lambda t, x, p: jnp.zeros(2)), ["RunningCost: ell(t, x, p)", "shape (); got shape (2,)"]),
        (
            sf.TerminalCost(lambda t, x, p: x[0]),
            ["TerminalCost is called as phi(x, p), but takes the arguments (t, x, p)"],
        ),
    ],
)
def test_observations_and_costs(data, said):
    refused(lambda: problem(experiment(data=data)), ValueError, *said)


def test_integers_and_booleans_are_taken_for_numbers():
    """A constant velocity written as ``jnp.array([1])`` is no mistake of the user's."""
    with use_float64():
        for value in (jnp.array([1]), jnp.array([True]), [1], 1):
            array = call_for_vector(Call(lambda value=value: value, (), (1,), "mode", "f()"), ())
            assert array.dtype == jnp.float64
            np.testing.assert_array_equal(array, [1.0])


# Where the guess cannot be integrated


def broken_beyond_half(t, x, p):
    return x * jnp.sqrt(0.5 - t)


def on_a_long_horizon(mode, **settings):
    run = experiment(transition_times=(5.0,), tf=10.0)
    return problem(run, system(modes={"grow": mode, "shrink": decay}), **settings)


def test_a_vector_field_that_returns_nan_is_named_with_t_and_x():
    nowhere = problem(of=system(modes={"grow": grow, "shrink": broken_beyond_half}))
    refused(lambda: sf.evaluate(nowhere), ValueError, "mode 'shrink' returned [nan] at t = 0.5", "x = [1.", "guess")


def fit_once(problem):
    return sf.estimate(problem, strategy="local")


@pytest.mark.parametrize("call", [sf.simulate, fit_once, sf.evaluate])
def test_a_state_that_blows_up(call):
    """x' = x**2 from 1 is infinite at t = 1."""
    blowing_up = on_a_long_horizon(lambda t, x, p: x**2)
    said = ["mode 'grow' cannot be integrated at the guess beyond t = 1 s, where x = [", "a better guess"]
    refused(lambda: call(blowing_up), ValueError, *said)


def test_a_state_that_overflows():
    said = ["mode 'grow'", "at t = 0.7", "grows without bound", "better guess"]
    refused(lambda: sf.evaluate(on_a_long_horizon(lambda t, x, p: 1000.0 * x)), ValueError, *said)


def test_a_running_cost_that_returns_nan():
    nowhere = problem(experiment(data=sf.RunningCost(lambda t, x, p: jnp.sqrt(0.3 - t))))
    refused(lambda: sf.evaluate(nowhere), ValueError, "a running cost in mode 'grow' returned nan at t = 0.3", "x = [")


def test_an_initial_state_that_is_nan():
    nowhere = problem(of=system(initial_state=lambda p: [jnp.sqrt(-p["k"])]))
    refused(lambda: sf.evaluate(nowhere), ValueError, "initial_state at p = {'k': 1.0} returned [nan]")


def test_a_reset_map_that_returns_nan():
    nowhere = problem(of=system(reset_maps={("grow", "shrink"): lambda t, x, p: jnp.sqrt(-x)}))
    refused(lambda: sf.evaluate(nowhere), ValueError, "reset map ('grow', 'shrink') at t = 0.4 s, x = [1.49", "[nan]")


def test_a_cost_that_is_nan_at_the_guess_ends_with_its_own_status():
    found = sf.estimate(problem(experiment(data=sf.TerminalCost(lambda x, p: jnp.sqrt(-x[0])))))
    assert found.status is sf.Status.NONFINITE_START
    assert not found.success
    assert "not finite at the starting point" in found.message


# Calls


GOOD = problem()
GOOD_THREE = problem(three_modes((0.3, 0.6)))


@pytest.mark.parametrize("call", [sf.evaluate, sf.simulate, sf.check_derivatives])
@pytest.mark.parametrize(
    ("theta", "said"),
    [
        ([0.4], ["theta must have shape (2,): tau_1, k; got shape (1,)"]),
        ([0.4, math.nan], ["theta must be finite; got [0.4, nan]"]),
        ("guess", ["theta must be a number or an array of numbers; got 'guess'"]),
        ([1.5, 1.0], ["must not decrease inside (t0, tf) = (0.0, 1.0); got [1.5]"]),
    ],
)
def test_theta(call, theta, said):
    refused(lambda: call(GOOD, theta), ValueError, *said)


def test_transition_times_in_theta_out_of_order():
    refused(lambda: sf.evaluate(GOOD_THREE, [0.6, 0.3, 1.0]), ValueError, "transition times in theta", "[0.6, 0.3]")


@pytest.mark.parametrize(
    ("build", "said"),
    [
        (lambda: sf.evaluate(GOOD, method="backward"), ["one of auto, forward, discrete-adjoint, adjoint"]),
        (lambda: sf.simulate(GOOD, experiment=1), ["experiment must lie in 0..0; got 1"]),
        (lambda: sf.estimate(GOOD, hessian="full"), ["hessian must be one of auto, exact, descent-first"]),
        (lambda: sf.estimate(GOOD, tolerance=0.0), ["tolerance must be positive; got 0.0"]),
        (lambda: sf.estimate(GOOD, max_iterations=-1), ["max_iterations must not be negative; got -1"]),
    ],
)
def test_settings(build, said):
    refused(build, ValueError, *said)


@pytest.fixture(scope="module")
def fit():
    """Two runs, not converged: what the results refuse does not depend on that."""
    return sf.estimate(problem([experiment(), experiment()]), max_iterations=0)


@pytest.mark.parametrize("level", [0.0, 95.0, math.nan])
def test_confidence_level(fit, level):
    refused(lambda: fit.confidence_intervals(level), ValueError, f"level must lie between 0 and 1; got {level}")


def test_the_trajectory_of_several_experiments(fit):
    refused(lambda: fit.trajectory, ValueError, "There are 2 experiments: use .trajectories[e]")


def test_a_reset_map_that_is_not_there():
    structure = GOOD.structures[0]
    refused(lambda: Model(structure, None).reset(0), ValueError, "transition 1 has no reset map")


# Noise, losses, priors, delays, scales


def noisy(sigma, more=None, **settings):
    data = sf.Measurements(TIMES, np.ones(5), observe=first_state, sigma=sigma, **settings)
    return problem(experiment(data=data), parameters={"k": 1.0} | (more or {}))


POSITIVE = sf.Parameter(0.1, lower=0.01)
PRIOR = {"k": sf.Parameter(1.0, prior=sf.Normal(1.0, 0.1))}


@pytest.mark.parametrize(
    ("build", "error", "said"),
    [
        (lambda: samples(sigma=["s", 1.0]), ValueError, ["sigma must have one entry for each of the 1 channels"]),
        (
            lambda: samples(values=[[1.0, 2.0]], sigma=["s", None]),
            TypeError,
            ["sigma of a channel (a number, or the name of a parameter) must be a number", "got None"],
        ),
        (lambda: samples(loss="Huber"), ValueError, ["one of linear, soft_l1, huber, cauchy; got 'Huber'"]),
        (lambda: samples(sigma=1.0, loss="huber", loss_scale=0.0), ValueError, ["loss_scale must be positive", "0.0"]),
        (lambda: samples(loss="huber"), ValueError, ["loss='huber' measures residuals in units of sigma", "left out"]),
        (lambda: samples(sigma="s", loss="cauchy"), ValueError, ["needs a loss_scale above 1", "got 1.0"]),
        (lambda: samples(delay=math.nan), ValueError, ["delay must be finite; got nan"]),
        (lambda: samples(delay=[1.0, 2.0]), ValueError, ["delay (a number, or the name of a parameter) must be a"]),
        (lambda: noisy("s"), ValueError, ["sigma names the parameter 's', which the problem lacks; it has k"]),
        (lambda: noisy("s", {"s": 0.1}), ValueError, ["must be one number that stays positive", "lower bound -inf"]),
        (lambda: noisy("s", {"s": sf.Parameter([0.1], lower=0.01)}), ValueError, ["one number", "got shape (1,)"]),
        (
            lambda: problem(
                experiment(data=[samples(observe=first_state), samples(observe=first_state, sigma="s")]),
                parameters={"k": 1.0, "s": POSITIVE},
            ),
            ValueError,
            ["sigma is left out in some Measurements, and a parameter", "Name a parameter for it there too"],
        ),
        (lambda: noisy(None, PRIOR), ValueError, ["a prior is weighed against the noise", "sigma is left out"]),
        (lambda: noisy(0.1, delay="late"), ValueError, ["delay names 'late', which must be a parameter of one number"]),
        (
            lambda: noisy(0.1, {"d": 0.0}, delay="d"),
            ValueError,
            ["may lie in [-inf, inf]", "only from 0 to 0 s are all"],
        ),
        (
            lambda: noisy(0.1, {"d": sf.Parameter(0.1, 0.0, 0.3)}, delay="d"),
            ValueError,
            ["the delay 'd' may lie in [0.0, 0.3]", "give it narrower bounds, move t0 or tf, or leave out samples"],
        ),
        (lambda: noisy(0.1, delay=0.1), ValueError, ["Measurements times less the delay of 0.1 must lie inside"]),
        (
            lambda: sf.evaluate(
                problem(
                    experiment(data=sf.Measurements([0.5], [1.0], observe=first_state, sigma=1.0, delay="d")),
                    parameters={"k": 1.0, "d": sf.Parameter(0.1, 0.0, 0.3)},
                ),
                [0.4, 1.0, 0.6],
            ),
            ValueError,
            ["theta has delays with which samples are of moments from -0.1 to -0.1 s, outside (t0, tf) = (0.0, 1.0)"],
        ),
        (lambda: sf.Parameter(1.0, scale="ln"), ValueError, ["Parameter scale must be 'linear' or 'log'; got 'ln'"]),
        (lambda: sf.Parameter(0.0, scale="log"), ValueError, ["with scale='log' must be positive", "the value 0.0"]),
        (lambda: sf.Parameter(1.0, -1.0, scale="log"), ValueError, ["its lower bound 0 or more", "lower bound -1.0"]),
        (lambda: sf.Parameter(1.0, prior=0.1), TypeError, ["must be an sf.Normal or an sf.LogNormal; got 0.1"]),
        (lambda: sf.Parameter(1.0, prior=sf.Normal([1, 2], 1)), ValueError, ["does not fit a value of shape ()"]),
        (
            lambda: sf.Parameter(1.0, prior=sf.LogNormal(1.0, 0.1)),
            ValueError,
            ["must stay positive", "lower bound -inf"],
        ),
        (lambda: sf.Normal(0.0, 0.0), ValueError, ["Normal sd must be positive and finite; got", "0.0"]),
        (lambda: sf.LogNormal(0.0, 1.0), ValueError, ["LogNormal median must be positive; got 0.0"]),
    ],
)
def test_noise_losses_priors_delays_and_scales(build, error, said):
    refused(build, error, *said)


def test_starts_of_a_logarithm_without_a_lower_bound_are_drawn_down_to_a_tenth_of_the_guess():
    this = problem(parameters={"k": sf.Parameter(1.0, upper=2.0, scale="log")})
    drawn = sf.multistart(this, 16).start[:, list(this.theta_names).index("k")]
    assert 0.1 <= drawn.min() < 0.3
    assert 1.5 < drawn.max() <= 2.0


# --- indices ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mode", "message"),
    [
        (lambda t, x, p: x * x[2], "reads index 2 of an array of size 2"),
        (lambda t, x, p: x[jnp.array([1, 2])], "reads index 2 of an array of size 2"),
        (lambda t, x, p: x * p["gains"][0, 3], r"reads index 3 of axis 1 of an array of shape \(2, 3\)"),
        (lambda t, x, p: x * jax.jit(lambda x: x[5])(x), "reads index 5 of an array of size 2"),
        (lambda t, x, p: jnp.where(t > 1.0, x[4], 0.0) * x, "reads index 4 of an array of size 2"),
        (lambda t, x, p: x.at[5].set(p["a"]), "writes to index 5 of an array of size 2"),
        (lambda t, x, p: x.at[-3].add(p["a"]), "writes to index -3 of an array of size 2"),
        (lambda t, x, p: x.at[jnp.array([1, 2])].multiply(p["a"]), "writes to index 2 of an array of size 2"),
        (lambda t, x, p: x.at[2].apply(jnp.sin), "writes to index 2 of an array of size 2"),
        (lambda t, x, p: jax.jvp(lambda x: x.at[4].set(0.0), (x,), (x,))[1], "writes to index 4 of an array of size 2"),
        (
            lambda t, x, p: p["gains"].at[:, 3].set(0.0)[0, :2],
            r"writes to index 3 of axis 1 of an array of shape \(2, 3\)",
        ),
        (lambda t, x, p: jax.lax.dynamic_update_slice(x, jnp.ones(2), (1,)), "writes to index 1 of an array of size 2"),
    ],
)
def test_an_index_that_is_out_of_range_is_an_error(mode, message):
    """JAX reads the nearest entry instead: x[2] of two states would be the last one, without a word."""
    times = np.arange(5.0)
    run = sf.Experiment(sf.Measurements(times, np.zeros((5, 2)), sigma=0.1), ["m"], [])
    with pytest.raises(ValueError, match=rf"mode 'm' {message} \(test_bad_input\.py:\d+\): its indices are 0 to \d"):
        sf.Problem(
            sf.HybridSystem({"m": mode}, [1.0, 2.0]),
            run,
            {"gains": sf.Parameter(np.ones((2, 3)), fixed=True), "a": 1.0},
        )


@pytest.mark.parametrize(
    "mode",
    [
        lambda t, x, p: x.at[5].add(
            p["a"],
            mode="clip",
        ),
        lambda t, x, p: x.at[1:5].set(p["a"]),
        lambda t, x, p: x.at[2:].set(p["a"]),
        lambda t, x, p: x.at[-2].set(p["a"]),
        lambda t, x, p: p["gains"].at[:, 2].set(p["a"])[1, :2],
        lambda t, x, p: p["gains"].at[1, 1:].set(p["a"])[1, :2],
        lambda t, x, p: jax.grad(lambda x: x.at[9].get(mode="fill", fill_value=0.0) ** 2 + p["a"] * x[0])(x),
        lambda t, x, p: jax.ops.segment_sum(x, np.array([0, 7]), num_segments=2) * p["a"],
    ],
)
def test_an_update_that_says_what_an_index_out_of_range_means_is_accepted(mode):
    system = sf.HybridSystem({"m": mode}, [1.0, 2.0])
    run = sf.Experiment(sf.TerminalCost(lambda x, p: x[0]), ["m"], [], 0.0, 1.0)
    gains = sf.Parameter(np.ones((2, 3)), fixed=True)
    assert np.isfinite(sf.evaluate(sf.Problem(system, run, {"gains": gains, "a": 1.0})).cost)


def test_an_output_with_an_index_that_is_out_of_range_is_an_error():
    log = sf.Measurements([0.0, 1.0], [0.0, 0.0], observe=lambda t, x, p: x[1], sigma=0.1)
    with pytest.raises(ValueError, match=r"observe reads index 1 of an array of size 1 .*: its indices are 0 to 0"):
        sf.Problem(
            sf.HybridSystem({"m": lambda t, x, p: -p["a"] * x}, [1.0]), sf.Experiment(log, ["m"], []), {"a": 1.0}
        )


def test_indices_that_are_in_range_or_say_what_else_they_mean():
    def mode(t, x, p):
        table = jnp.interp(t, jnp.arange(3.0), jnp.array([0.0, 1.0, 2.0]))
        absent = x.at[5].get(mode="fill", fill_value=1.0) + x.at[7].get(mode="clip")
        moved = jnp.roll(x, 1) * x[jnp.array([-1, -2])] * x[-2] * jnp.flip(x)
        return -p["a"] * x + 0.01 * (table * absent * moved + x[jnp.searchsorted(jnp.arange(1.0, 2.0), t)])

    run = sf.Experiment(sf.Measurements([0.0, 1.0], np.zeros((2, 2)), sigma=0.1), ["m"], [])
    assert np.isfinite(sf.evaluate(sf.Problem(sf.HybridSystem({"m": mode}, [1.0, 2.0]), run, {"a": 1.0})).cost)
