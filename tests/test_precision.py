"""Numbers that lost digits in single precision are refused with their names."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import switchfit as sf
from switchfit.precision import first_loss

K = jnp.array(0.1)  # JAX is in 32-bit mode here, as it is in a user's module
EXACT = jnp.array([0.5, 2.0])
TIMES = np.linspace(0.0, 1.0, 9)


def problem_of(mode=None, initial_state=(1.0,), data=None, reset=None, guard=None, inputs=None):
    system = sf.HybridSystem(
        {"on": mode or (lambda t, x, p: -p["a"] * x), "off": lambda t, x, p: -0.5 * x},
        initial_state,
        reset_maps={} if reset is None else {("on", "off"): reset},
        guards={} if guard is None else {("on", "off"): guard},
    )
    data = data or sf.Measurements(TIMES, np.exp(-TIMES), sigma=0.1)
    return sf.Problem(system, sf.Experiment(data, ("on", "off"), (0.4,), 0.0, 1.0, inputs=inputs), {"a": 0.8})


class Body:
    def __init__(self):
        self.gain = jnp.array([0.1])

    def __call__(self, t, x, p):
        return -self.gain * p["a"] * x


def by_default(t, x, p, k=K):
    return k * x


def by_closure():
    drag = jnp.array([0.5, 0.3])
    return lambda t, x, p: -drag[1] * x


def by_numpy():
    drag = np.array([0.3], np.float32)
    return lambda t, x, p: -drag * x


def by_half():
    drag = jnp.array([0.3], jnp.bfloat16)
    return lambda t, x, p: -drag * x


def by_dict():
    constants = {"drag": jnp.array(0.3)}
    return lambda t, x, p: -constants["drag"] * x


def by_loop():
    drag = jnp.array(0.3)
    return lambda t, x, p: jax.lax.fori_loop(0, 2, lambda k, y: y - drag * x, x)


def by_arithmetic():
    return lambda t, x, p: -(EXACT[0] / EXACT[1] / 10.0) * x


def scaled(x, k):
    return k * x


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (
            lambda: {"mode": lambda t, x, p: -K * p["a"] * x},
            "mode 'on' uses the constant K, .* 0.1 became 0.1000000014",
        ),
        (lambda: {"mode": lambda t, x, p: -jnp.sin(K) * x}, "mode 'on' uses the constant K"),
        (lambda: {"mode": by_closure()}, "mode 'on' uses the constant drag, .*: 0.3 became 0.30000001192092896"),
        (lambda: {"mode": by_numpy()}, r"mode 'on' uses the constant drag, .*\(float32\)"),
        (lambda: {"mode": by_half()}, r"mode 'on' uses the constant drag, .*\(bfloat16\)"),
        (lambda: {"mode": by_dict()}, r"mode 'on' uses the constant constants\['drag'\]"),
        (lambda: {"mode": by_loop()}, "mode 'on' uses the constant drag"),
        (
            lambda: {"mode": by_arithmetic()},
            r"mode 'on' uses a constant \(test_precision.py:\d+\).*0.025 became",
        ),
        (lambda: {"mode": Body()}, "mode 'on' uses the constant self.gain"),
        (lambda: {"mode": by_default}, "mode 'on' uses the constant k"),
        (lambda: {"mode": functools.partial(lambda k, t, x, p: k * x, K)}, "mode 'on' uses the constant"),
        (lambda: {"mode": lambda t, x, p: jax.jit(scaled)(x, K)}, "mode 'on' uses the constant K"),
        (lambda: {"mode": lambda t, x, p: -jnp.float32(0.3) * x}, "mode 'on' uses a constant.*0.3 became"),
        (lambda: {"reset": lambda t, x, p: K * x}, r"reset map \('on', 'off'\) uses the constant K"),
        (lambda: {"guard": lambda t, x, p: x[0] - K}, r"guard \('on', 'off'\) uses the constant K"),
        (lambda: {"initial_state": lambda p: jnp.ones(1) * K}, "initial_state uses the constant K"),
        (lambda: {"data": sf.RunningCost(lambda t, x, p: K * x[0])}, "RunningCost uses the constant K"),
        (lambda: {"data": sf.TerminalCost(lambda x, p: K * x[0])}, "TerminalCost uses the constant K"),
        (
            lambda: {"data": [sf.RunningCost(lambda t, x, p: x[0]), sf.TerminalConstraint(lambda x, p: x[0] - K)]},
            "TerminalConstraint uses the constant K",
        ),
        (
            lambda: {"data": sf.Measurements(TIMES, TIMES, observe=lambda t, x, p: K * x, sigma=1.0)},
            "observe uses the constant K",
        ),
        (
            lambda: {"data": sf.ReferenceSignal.from_samples(TIMES, TIMES, observe=lambda t, x, p: K * x)},
            "observe uses the constant K",
        ),
    ],
)
def test_a_constant_in_single_precision_is_refused_by_its_name(make, said):
    with pytest.raises(ValueError, match=said) as caught:
        problem_of(**make())
    assert "np.array" in str(caught.value), "what to write instead"


@pytest.mark.parametrize(
    "mode",
    [
        lambda t, x, p: x.astype(jnp.float32).astype(jnp.float64),
        lambda t, x, p: jnp.float32(0.5) * x.astype(jnp.float32) + 0.0 * x,
        lambda t, x, p: jax.lax.fori_loop(0, 2, lambda k, y: y.astype(jnp.float16).astype(jnp.float64), x),
    ],
)
def test_a_function_that_casts_is_refused(mode):
    with pytest.raises(ValueError, match=r"mode 'on' computes in float(32|16) \(test_precision.py:\d+\)"):
        problem_of(mode)


@pytest.mark.parametrize(
    "mode",
    [
        lambda t, x, p: -EXACT[0] * p["a"] * x,
        lambda t, x, p: -jnp.array([0.1]) * p["a"] * x,
        lambda t, x, p: x[jnp.array([0])] * p["a"],
        lambda t, x, p: -np.float64(0.1) * x,
        lambda t, x, p: -(EXACT[0] * EXACT[1]) * x,
        lambda t, x, p: jnp.where(EXACT[:1] > 0.25, x, -x),
    ],
)
def test_constants_that_lost_nothing_are_taken(mode):
    sf.evaluate(problem_of(mode))


def test_what_is_taken_is_what_was_meant():
    taken, meant = (sf.evaluate(problem_of(lambda t, x, p, k=k: -k * p["a"] * x)) for k in (EXACT[1], 2.0))
    np.testing.assert_array_equal(taken.hessian, meant.hessian)


@settings(max_examples=300, deadline=None)
@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_a_number_passes_if_it_is_what_its_text_says(number):
    short = np.float32(number)
    loses = float(str(short)) != float(short)
    found = first_loss(np.array([0.5, short], np.float32))
    assert (found is not None) == loses
    if found is not None:
        assert np.float32(found[0]) == short
        assert float(found[1]) == float(short)


@pytest.mark.parametrize(
    "values", [np.array([np.nan, np.inf, -np.inf, 0.0, 1e10], np.float32), [0.1], np.array(0.1), 3]
)
def test_nothing_is_lost(values):
    assert first_loss(values) is None
