"""Every `raise` that a user can reach: the message names the thing, says what was given and what to do."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.models import decay, first_state
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


def problem(run=None, of=None, parameters=None, **settings):
    parameters = {"k": 1.0} if parameters is None else parameters
    return sf.Problem(system() if of is None else of, experiment() if run is None else run, parameters, **settings)


def reference(times=TIMES, values=TIMES, **settings):
    return sf.ReferenceSignal.from_samples(times, values, **settings)


def samples(times=(0.5,), values=(1.0,), **settings):
    return sf.Measurements(times, values, **settings)


def seen(**settings):
    """A sample of the only state."""
    return samples(observe=first_state, **settings)


def with_data(*data, **changes):
    return problem(experiment(data=list(data)), **changes)


def noisy(sigma, more=None, **settings):
    data = seen(times=TIMES, values=np.ones(5), sigma=sigma, **settings)
    return with_data(data, parameters={"k": 1.0} | (more or {}))


def starting_at(initial_state):
    return problem(of=system(initial_state=initial_state))


def with_modes(mode, run=None):
    return problem(run, system(modes={"grow": mode, "shrink": decay}))


def on_a_long_horizon(mode):
    return with_modes(mode, experiment(transition_times=(5.0,), tf=10.0))


def two(t, x, p):
    return jnp.zeros(2)


GOOD = problem()
RUNNING = sf.RunningCost(lambda t, x, p: x[0])
BROKEN = sf.RunningCost(lambda t, x, p: jnp.sqrt(0.3 - t))
KNOWN, PAIR = sf.Parameter(0.4, fixed=True), ("grow", "shrink")
NOISE = {"k": 1.0, "s": sf.Parameter(0.1, lower=0.01)}
PRIOR = {"k": sf.Parameter(1.0, prior=sf.Normal(1.0, 0.1))}
LATE = {"k": 1.0, "d": sf.Parameter(0.1, 0.0, 0.3)}


def refused(build, error, *said):
    """`build` raises `error`, and the message contains every one of the pieces `said`."""
    with pytest.raises(error) as caught:
        build()
    message = str(caught.value)
    for piece in said:
        assert piece in message, f"{piece!r} is missing in: {message}"
    assert message.endswith("."), f"not a sentence: {message}"


def refused_with(*rows, error):
    """Return a test of rows (build, pieces of the message)."""

    @pytest.mark.parametrize(("build", "said"), rows)
    def check(build, said):
        refused(build, error, *said)

    return check


test_wrong_types = refused_with(
    (lambda: system(modes={1: grow}), ["mode names must be strings; got 1"]),
    (lambda: system(modes={"grow": 3}), ["mode 'grow' must be a function f(t, x, p); got 3"]),
    (lambda: system(reset_maps={"grow": grow}), ["reset_maps must be a dict of (mode before, mode after)", "grow"]),
    (lambda: samples(observe=3), ["observe must be a function h(t, x, p); got 3"]),
    (lambda: samples(sigma={"x": 1}), ["sigma must be a number or an array of numbers; got {'x': 1}"]),
    (lambda: sf.ReferenceSignal(TIMES), ["by sf.ReferenceSignal.from_samples(times, values, ...)"]),
    (lambda: sf.Parameter(1.0, prior=0.1), ["must be an sf.Normal or an sf.LogNormal; got 0.1"]),
    (lambda: experiment(mode_sequence="grow"), ["mode_sequence must be a sequence of mode names; got 'grow': giv"]),
    (lambda: experiment(data=[SAMPLES, 3]), ["data must be sf.Measurements", "or a list of them; got int"]),
    (lambda: problem(of=3), ["system must be an sf.HybridSystem; got int"]),
    (lambda: problem([SAMPLES]), ["experiments must be an sf.Experiment or a list of them; got Measurements"]),
    (lambda: problem(parameters=["k"]), ["parameters must be a dict of name -> value", "got ['k']"]),
    error=TypeError,
)


test_wrong_values = refused_with(
    # Systems
    (lambda: system(modes={}), ["modes must be a non-empty dict", "got {}"]),
    (lambda: system(initial_state=[]), ["initial_state must have shape (n,)", "got shape (0,)"]),
    (lambda: system(initial_state=[math.nan]), ["initial_state must be finite; got nan at index [0]"]),
    (lambda: system(reset_maps={("grow", "fall"): grow}), ["reset_maps names the unknown mode 'fall'; the modes"]),
    (lambda: problem(of=system(initial_state=lambda p: p["k"][None], state_names=("x", "y"))), ["of the 1 states"]),
    # Data
    (lambda: samples([0.0, 0.0], [1.0, 2.0]), ["got 0.0 followed by 0.0 at index 1. Samples of the same time go"]),
    (lambda: samples([0.0, 1.0], [1.0]), ["values of shape (K,) or (K, q); got (2,) and (1,)"]),
    (lambda: samples([], np.empty((0, 0))), ["Measurements needs 1 sample(s) or more; got 0"]),
    (lambda: samples([], np.empty((0, 2)), sigma=np.empty((0, 2))), ["sigma must be", "shape (2,)"]),
    (lambda: samples([math.nan], [1.0]), ["Measurements times must be finite; got nan at index [0]"]),
    (lambda: samples([0.0], [[[1.0]]]), ["values of shape (K,) or (K, q)", "(1,) and (1, 1, 1)"]),
    (lambda: samples([0.0], [math.inf]), ["must be finite, or NaN where a sample is missing"]),
    (lambda: samples([0.0], [math.nan]), ["Measurements values are all NaN: there is nothing to fit"]),
    (lambda: samples(sigma=0.0), ["sigma must be positive and finite", "0.0"]),
    (lambda: samples(sigma=[1.0, 2.0]), ["sigma must be", "of shape (1,) (one per channel)", "(2,)"]),
    (lambda: samples(sigma=["s", 1.0]), ["sigma must have one entry for each of the 1 channels"]),
    (lambda: samples(loss="Huber"), ["one of linear, soft_l1, huber, cauchy; got 'Huber'"]),
    (lambda: samples(sigma=1.0, loss="huber", loss_scale=0.0), ["loss_scale must be positive", "0.0"]),
    (lambda: samples(loss="huber"), ["loss='huber' measures residuals in units of sigma: give it"]),
    (lambda: samples(sigma="s", loss="cauchy"), ["needs a loss_scale above 1", "got 1.0"]),
    (lambda: samples(delay=math.nan), ["delay (a number, or the name of a parameter) must be finite; got nan"]),
    (lambda: sf.Input([0, 1, 2], [1, 2, 3], kind="cubic"), ["Input needs 4 sample(s) or more; got 3"]),
    (lambda: reference([0, 1, 2, 2, 3], [1, 2, 3, 4, 5]), ["four samples or more in each part; got 2"]),
    (lambda: reference(weights=[1.0, 2.0]), ["weights must have shape (1,) or (1, 1); got (2,)"]),
    (lambda: reference(values=np.zeros((5, 2)), weights=[[1.0, 2.0], [0.0, 1.0]]), ["symmetric and positive semi"]),
    (lambda: reference(weights=[-1.0]), ["positive semi-definite; got [[-1.0]]"]),
    # Parameters
    (lambda: sf.Parameter([1.0, 2.0], lower=[1, 2, 3]), ["lower must fit the value, of shape (2,)", "1.0, 2.0, 3"]),
    (lambda: sf.Parameter([]), ["Parameter value must have one entry or more"]),
    (lambda: sf.Parameter(math.nan), ["Parameter value must be finite; got nan"]),
    (lambda: sf.Parameter(1.5, lower=2.0, upper=1.0), ["Parameter lower must not be above upper; got [2.0, 1.0]"]),
    (lambda: sf.Parameter(0.0, scale="log"), ["with scale='log' must be positive; got 0.0"]),
    (lambda: sf.Parameter(1.0, -1.0, scale="log"), ["with scale='log' must be positive", "lower bound -1.0"]),
    (lambda: sf.Parameter(1.0, prior=sf.Normal([1, 2], 1)), ["prior must fit the value, of shape ()"]),
    (lambda: sf.Parameter(1.0, prior=sf.LogNormal(1.0, 0.1)), ["needs a lower bound above 0", "lower bound -inf"]),
    (lambda: sf.LogNormal(0.0, 1.0), ["LogNormal median must be positive; got 0.0"]),
    # Experiments
    (lambda: experiment(t0=1.0, tf=0.0), ["finite horizon with t0 < tf; got (1.0, 0.0)"]),
    (lambda: experiment(t0=[0.0, 1.0]), ["t0 must be a single number; got [0.0, 1.0]"]),
    (lambda: experiment(mode_sequence=()), ["mode_sequence is empty; name at least one mode"]),
    (lambda: experiment(transition_times=()), ["one fewer than the 2 modes", "got 0"]),
    (lambda: experiment(transition_times=(1.5,)), ["increase strictly inside (t0, tf) = (0.0, 1.0); got [1.5]"]),
    (lambda: experiment(transition_times=(math.nan,)), ["a transition time must be a number", "must be finite; g"]),
    (lambda: experiment(transition_times=[[0.5, 0.6]]), ["transition time 1 must be a single number", "(2,)"]),
    (lambda: experiment(data=[]), ["data is empty: an experiment needs at least one cost"]),
    (lambda: problem([]), ["experiments is empty: a problem needs at least one sf.Experiment"]),
    (lambda: experiment(data=samples([-1, 0.5, 2], [1, 1, 1])), ["inside [t0, tf] = [0.0, 1.0]; 2 of 3 do not"]),
    (lambda: experiment(data=reference(TIMES / 2)), ["over (t0, tf) = (0.0, 1.0)", "from 0.0 to 0.5", "Give t0"]),
    # What the horizon is taken from
    (lambda: experiment(data=RUNNING, t0=None, tf=None), ["t0 and tf must be given, as nothing among the data (R"]),
    (lambda: experiment(data=samples(), t0=None, tf=None), ["got (0.5, 0.5) (t0 and tf from the data)"]),
    # Problems
    (lambda: problem(solver="euler"), ["solver must be 'auto', 'explicit' or 'stiff'; got 'euler'"]),
    (lambda: problem(rtol=0), ["rtol must be positive; got 0.0"]),
    (lambda: problem(rtol=1e-16), ["rtol must lie between 1e-13", "got 1e-16"]),
    (lambda: problem(parameters={"k": "x"}), ["parameter 'k' must be a number, an array or an sf."]),
    (lambda: problem(experiment(transition_times=(KNOWN,)), parameters={"k": KNOWN}), ["Nothing to estimate: eve"]),
    (lambda: with_data(samples(values=[[1.0, 2.0]])), ["whole state is compared: its 1 entries; got 2", "-> (2,)"]),
    # Noise, priors and delays of a problem
    (lambda: noisy("s"), ["sigma names 's', which must be a parameter of one number; the problem has k"]),
    (lambda: noisy("s", {"s": 0.1}), ["which must stay positive", "lower bound -inf"]),
    (lambda: with_data(seen(), seen(sigma="s"), parameters=NOISE), ["sigma is left out in some Measurements, and"]),
    (lambda: noisy(None, PRIOR), ["something is weighed against the noise: a prior", "sigma is left out"]),
    (lambda: noisy(0.1, LATE, delay="d"), ["the delay 'd' may lie in [0.0, 0.3]", "narrower bounds, move t0"]),
    (lambda: noisy(0.1, delay=0.1), ["Measurements times less the delay of 0.1 must lie inside"]),
    # Functions of other kinds than modes
    (lambda: problem(experiment(inputs=sf.Input([0.0], [1.0]))), ["is called as f(t, x, p, u), but takes the arg"]),
    (lambda: problem(of=system(reset_maps={PAIR: two})), ["reset map ('grow', 'shrink')", "R(t, x, p) must "]),
    (lambda: starting_at(lambda p: p["k"]), ["initial_state(p) must return an array of shape (n,); got shape ()"]),
    (lambda: with_data(samples(observe=lambda t, x, p: x[1])), ["observe reads index 1 of", "size 1", "are 0 to 0"]),
    (lambda: with_data(samples(observe=two)), ["observe: h(t, x, p)", "shape (1,); got shape (2,)"]),
    (lambda: with_data(sf.RunningCost(two)), ["RunningCost: ell(t, x, p)", "shape (); got shape (2,)"]),
    (lambda: with_data(sf.TerminalCost(grow)), ["TerminalCost is called as phi(x, p), but takes the arguments (t"]),
    # Where the guess cannot be integrated
    (lambda: sf.evaluate(on_a_long_horizon(lambda t, x, p: 1000.0 * x)), ["at t = 0.7", "grows without bound"]),
    (lambda: sf.evaluate(with_data(BROKEN)), ["a running cost in mode 'grow' returned nan at t = 0.3", "x = ["]),
    (lambda: sf.evaluate(starting_at(lambda p: [jnp.sqrt(-p["k"])])), ["at p = {'k': 1.0} returned [nan]"]),
    # Calls
    (lambda: sf.evaluate(GOOD, method="backward"), ["'auto', 'forward' or 'adjoint'"]),
    (lambda: sf.evaluate(GOOD, method="autodiff"), ["'auto', 'forward' or 'adjoint'"]),
    (lambda: sf.evaluate(GOOD, method="discrete-adjoint"), ["'auto', 'forward' or 'adjoint'"]),
    error=ValueError,
)


@pytest.mark.parametrize(
    ("mode", "said"),
    [
        (lambda t, x, p: jnp.zeros(2), ["f(t, x, p) must return an array of shape (1,); got shape (2,)"]),
        (lambda t, x, p: x.astype(jnp.float32), ["must return float64; got float32", "do not cast them"]),
        (lambda t, x, p: None, ["must return an array of numbers; got None"]),
        (lambda t, x, p: x if x[0] > 0 else -x, ["branches on the value of t, x or p (an `if`", "make it a mode with"]),
        (lambda t, x, p: np.array([x[0]]), ["calls a NumPy function on t, x or p, or", "Write it with jax.numpy"]),
        (lambda t, x, p: p["q"] * x, ["reads 'q', which is not there: p has k"]),
        (lambda t, x: x, ["is called as f(t, x, p), but takes the arguments (t, x)"]),
        (lambda t, x, p: x.velocity, ["f(t, x, p) raised AttributeError", "velocity"]),
    ],
)
def test_vector_field(mode, said):
    refused(lambda: with_modes(mode), ValueError, "mode 'grow'", *said)


def test_integers_and_booleans_are_taken_for_numbers():
    """A constant velocity written as ``jnp.array([1])`` is no mistake of the user's."""
    with use_float64():
        for value in (jnp.array([1]), jnp.array([True]), [1], 1):
            array = call_for_vector(Call(lambda value=value: value, (), (1,), "mode", "f()"), ())
            assert array.dtype == jnp.float64
            np.testing.assert_array_equal(array, [1.0])


@pytest.mark.parametrize("call", [sf.simulate, partial(sf.estimate, strategy="local"), sf.evaluate])
def test_a_state_that_blows_up(call):
    """x' = x**2 from 1 is infinite at t = 1."""
    blowing_up = on_a_long_horizon(lambda t, x, p: x**2)
    said = ["mode 'grow' cannot be integrated at the guess beyond t = 1 s, where x = [", "a better guess"]
    refused(lambda: call(blowing_up), ValueError, *said)


@pytest.mark.parametrize("call", [sf.evaluate, sf.simulate, sf.check_derivatives])
def test_theta(call):
    refused(lambda: call(GOOD, [0.4, math.nan]), ValueError, "theta must be finite; got nan at index [1]")


def test_results():
    """Two runs, not converged: what the results refuse does not depend on that."""
    fit = sf.estimate(problem([experiment(), experiment()]), max_iterations=0)
    refused(lambda: fit.trajectory, ValueError, "There are 2 experiments: use .trajectories[e]")


def problem_of_two_states(mode):
    run = sf.Experiment(sf.Measurements(TIMES, np.zeros((5, 2)), sigma=0.1), ["m"], [])
    gains = sf.Parameter(np.ones((2, 3)), fixed=True)
    return sf.Problem(sf.HybridSystem({"m": mode}, [1.0, 2.0]), run, {"gains": gains, "a": 1.0})


@pytest.mark.parametrize(
    ("mode", "message"),
    [
        (lambda t, x, p: x * x[2], "reads index 2 of an array of size 2"),
        (lambda t, x, p: x * p["gains"][0, 3], r"reads index 3 of axis 1 of an array of shape \(2, 3\)"),
        (lambda t, x, p: x * jax.jit(lambda x: x[5])(x), "reads index 5 of an array of size 2"),
        (lambda t, x, p: x.at[-3].add(p["a"]), "writes to index -3 of an array of size 2"),
        (lambda t, x, p: x.at[2].apply(jnp.sin), "writes to index 2 of an array of size 2"),
        (lambda t, x, p: jax.jvp(lambda x: x.at[4].set(0.0), (x,), (x,))[1], "writes to index 4 of an array of size 2"),
        (lambda t, x, p: p["gains"].at[:, 3].set(0.0)[0, :2], r"writes to index 3 of axis 1 .*of shape \(2, 3\)"),
        (lambda t, x, p: jax.lax.dynamic_update_slice(x, jnp.ones(2), (1,)), "writes to index 1 of an array of size 2"),
    ],
)
def test_an_index_that_is_out_of_range_is_an_error(mode, message):
    """JAX reads the nearest entry instead: x[2] of two states would be the last one, without a word."""
    with pytest.raises(ValueError, match=rf"mode 'm' {message} \(test_bad_input\.py:\d+\): its indices are 0 to \d"):
        problem_of_two_states(mode)


@pytest.mark.parametrize(
    "mode",
    [
        lambda t, x, p: x.at[5].add(p["a"], mode="clip"),
        lambda t, x, p: x.at[1:5].set(p["a"]),
        lambda t, x, p: x.at[-2].set(p["a"]),
        lambda t, x, p: p["gains"].at[1, 1:].set(p["a"])[1, :2],
        lambda t, x, p: jax.grad(lambda x: x.at[9].get(mode="fill", fill_value=0.0) ** 2 + p["a"] * x[0])(x),
        lambda t, x, p: jax.ops.segment_sum(x, np.array([0, 7]), num_segments=2) * p["a"],
        lambda t, x, p: x.at[5].get(mode="fill", fill_value=1.0) + x.at[7].get(mode="clip") - p["a"] * x,
        lambda t, x, p: 0.01 * jnp.roll(x, 1) * x[jnp.array([-1, -2])] * x[-2] * jnp.flip(x) - p["a"] * x,
        lambda t, x, p: x[jnp.searchsorted(jnp.arange(1.0, 2.0), t)] - p["a"] * x,
    ],
)
def test_an_update_that_says_what_an_index_out_of_range_means_is_accepted(mode):
    assert np.isfinite(sf.evaluate(problem_of_two_states(mode)).cost)
