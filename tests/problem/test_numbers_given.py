"""What comes through the door: numbers as they were given, or a sentence about the argument."""

import datetime
import time
from decimal import Decimal
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import switchfit as sf
from support.models import decay, first_state, refused
from switchfit.problem.validation.arrays import as_array, as_count
from switchfit.problem.validation.messages import LONGEST_SHOWN_VALUE, join_names, shorten
from switchfit.problem.validation.names import as_choice, as_sequence
from switchfit.problem.validation.objects import as_callable, as_path
from switchfit.problem.validation.precision import refuse_single_precision

# Single precision


def single(value):
    return np.asarray(value, dtype=np.float32)


def in_jax(value):
    return jnp.array(value, dtype=jnp.float32)


def run(data=None, **changes):
    given = {"data": samples(), "mode_sequence": ("decay", "decay"), "transition_times": (0.5,), "t0": 0.0, "tf": 1.0}
    return sf.Experiment(**(given | changes))


def samples(**changes):
    return sf.Measurements(**({"times": [0.25, 0.75], "values": [0.8, 0.5], "sigma": 0.1} | changes))


SYSTEM = sf.HybridSystem({"decay": decay}, [1.0])
PROBLEM = sf.Problem(SYSTEM, run(), {"k": sf.Parameter(1.0, 0.1, 5.0)})
REFERENCE = {"times": [0.0, 0.25, 0.5, 1.0], "values": [1.0, 0.8, 0.6, 0.4]}

NUMBERS = {
    "an entry of initial_state": lambda bad: run(initial_state=[sf.Parameter(1.0), bad(0.1)]),
    "tf": lambda bad: run(tf=bad(1.1)),
    "transition_times": lambda bad: run(transition_times=bad([0.1])),
    "a parameter": lambda bad: sf.Problem(SYSTEM, run(), {"k": bad(0.1)}),
    "values in a list": lambda bad: samples(values=[bad(0.1), 0.5]),
    "sigma of a channel": lambda bad: samples(values=[[1.0, 2.0]] * 2, sigma=["s", bad(0.1)]),
    "rtol": lambda bad: sf.Problem(SYSTEM, run(), {"k": 1.0}, rtol=bad(0.1)),
    "theta": lambda bad: sf.evaluate(PROBLEM, bad([0.1, 1.0])),
}


@pytest.mark.parametrize("precision", [single, in_jax], ids=["numpy", "jax"])
@pytest.mark.parametrize("door", NUMBERS)
def test_no_number_of_single_precision_changes_in_silence(door, precision):
    said = r"(0\.1 became 0\.10000000149|1\.1 became 1\.10000002384).* \(float32\)"
    with pytest.raises(ValueError, match=said) as caught:
        NUMBERS[door](precision)
    advice = "a list or a NumPy array" if precision is in_jax else "np.asarray(values, dtype=np.float64)"
    assert advice in str(caught.value)


@given(arrays(np.float32, st.integers(1, 20), elements=st.floats(width=32)))
def test_single_precision_is_refused_if_and_only_if_a_shortest_text_is_another_double(values):
    finite = values[np.isfinite(values)]
    changes = any(float(str(value)) != float(value) for value in finite)
    if not changes:
        assert refuse_single_precision(values, "values") is None
        return
    with pytest.raises(ValueError, match=r"values .* became .* \(float32\)"):
        refuse_single_precision(values, "values")


@pytest.mark.parametrize("kind", [np.float16, jnp.bfloat16, np.float32])
def test_halves_pass_and_tenths_do_not(kind):
    exact = jnp.array([0.5, -3.0, 0.0, np.nan, np.inf], dtype=kind)
    np.testing.assert_array_equal(as_array(exact, "x"), [0.5, -3.0, 0.0, np.nan, np.inf])
    assert as_array(exact, "x").dtype == np.float64
    with pytest.raises(ValueError, match=r"x must be in double precision: 0\.1\d* became 0\.\d+ \(\w*float\d+\)"):
        as_array(jnp.array([0.5, 0.1], dtype=kind), "x")


# Numbers


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (range(3), [0.0, 1.0, 2.0]),
        (np.int32(3), 3.0),
        ([np.float64(0.1), np.int64(2)], [0.1, 2.0]),
        ([Fraction(1, 4), Decimal("0.1")], [0.25, 0.1]),
        (np.array([1.0, 2], dtype=object), [1.0, 2.0]),
        ([np.array([1.0, 2.0]), [3, 4]], [[1.0, 2.0], [3.0, 4.0]]),
        (np.array([1.0, 2.0], dtype=">f8"), [1.0, 2.0]),
        (np.array([1.0, 2.0]), [1.0, 2.0]),
        (np.ma.array([1.0, 2.0], mask=[False, False]), [1.0, 2.0]),
    ],
)
def test_numbers_are_read_as_they_are(given, expected):
    array = as_array(given, "x")
    assert type(array) is np.ndarray
    assert array.dtype == np.float64
    np.testing.assert_array_equal(array, expected)
    assert not np.shares_memory(array, np.asarray(given))


ENDLESS = []
ENDLESS.append(ENDLESS)
DATES = [datetime.datetime(2020, 1, 1), datetime.datetime(2020, 1, 2)]


@pytest.mark.parametrize(
    ("given", "error", "said"),
    [
        (None, TypeError, "got None"),
        ([1.0, True], TypeError, "in which True is not a number"),
        (["1.0", 2.0], ValueError, "in which '1.0' is not a number"),
        (np.array(["1.0"]), ValueError, r"got \['1.0'\] \(<U3\)"),
        ({1.0, 2.0}, TypeError, "give a list or an array"),
        ((value for value in (1.0,)), TypeError, "give a list or an array"),
        (Fraction(10**400), ValueError, "beyond the largest double"),
        ([[1.0], [2.0, 3.0]], ValueError, "whose rows differ in length"),
        (DATES, TypeError, "dates and time differences are not supported.*np.timedelta64"),
        (np.array(DATES, dtype="datetime64[ns]"), TypeError, "dates and time differences are not supported"),
        (np.ma.array([1.0, 2.0], mask=[True, False]), ValueError, "a masked array: fill in what is masked"),
        (ENDLESS, ValueError, "nested more than 8 deep"),
        (np.zeros(2, dtype=[("a", float)]), TypeError, "got"),
    ],
)
def test_what_is_no_number_is_refused(given, error, said):
    with pytest.raises(error, match=rf"(?s)^x must be a number or an array of numbers.*{said}.*\.$"):
        as_array(given, "x")


# Counts, flags, choices, functions, paths


NO_COUNTS = [3.0, "3", None, True, np.True_, np.array([3])]
NO_FLAGS = [0, "yes", None, np.array([True])]
NO_LISTS = [{"a", "b"}, {"a": 1}, iter("ab"), 3, np.array(1.0)]


def test_what_is_accepted_is_returned():
    for three in (np.int64(3), np.array(3), jnp.array(3)):
        assert type(as_count(three, "runs")) is int
    assert as_choice(np.str_("b"), "kind", ("a", "b")) == "b"
    assert as_callable(first_state, "observe", "a function h(t, x, p)", arguments=3) is first_state
    assert as_callable(max, "observe", "a function", arguments=2) is max  # no signature


# Messages


LONG = ["x" * 10**7, [1.0] * 10**6, np.zeros(10**6), {k: k for k in range(10**5)}, 10**5000]


WITHOUT_TEXT = type("WithoutText", (), {"__repr__": lambda self: 1 / 0})()


@pytest.mark.parametrize("value", [*LONG, WITHOUT_TEXT, PROBLEM], ids=lambda value: type(value).__name__)
def test_what_messages_show_is_short(value):
    began = time.perf_counter()
    assert 0 < len(shorten(value)) <= LONGEST_SHOWN_VALUE
    assert time.perf_counter() - began < 0.5
    assert join_names(str(k) for k in range(1000)).endswith("9 and 990 more")


# What has been accepted without a word


TWO = [[1.0, 2.0]] * 2
HUGE = {"values": [1e308, -1e308, 1e308, -1e308]}


def filtered(hz):
    return sf.ReferenceSignal.from_samples(**REFERENCE, lowpass_hz=hz)


test_what_is_not_as_it_must_be_is_refused = refused(
    *((lambda bad=bad: as_count(bad, "n"), TypeError, "n must be a whole number") for bad in NO_COUNTS),
    *((lambda bad=bad: sf.Parameter(1.0, fixed=bad), TypeError, "must be True or False; got") for bad in NO_FLAGS),
    *((lambda bad=bad: as_sequence(bad, "n", "a list"), TypeError, "n must be a list; got") for bad in NO_LISTS),
    (lambda: as_count(-1, "seed"), ValueError, "seed must not be negative; got -1"),
    (lambda: as_count(10**400, "runs"), ValueError, r"runs must be at most 1000000000; got 1000\S*000"),
    (lambda: as_choice("c", "kind", ("a", "b")), ValueError, "kind must be 'a' or 'b'; got 'c'"),
    (lambda: as_choice(np.array(["a", "b"]), "kind", tuple("abcd")), TypeError, "must be one of a, b, c, d; got"),
    (lambda: as_callable(lambda: None, "f", "a function", arguments=1), TypeError, "cannot be called with 1"),
    (lambda: as_callable(int, "f", "a function"), TypeError, "f must be a function; got <class 'int'>"),
    (lambda: jax.jit(lambda x: as_array(x, "x"))(jnp.zeros(2)), TypeError, "NumPy cannot read .TracerArrayConver"),
    (lambda: as_path(None, "path"), TypeError, "path must be a path"),
    (lambda: as_path("", "path"), ValueError, "path must be a path"),
    (lambda: sf.identifiability(3), TypeError, "identifiability needs an sf.Estimate or an sf.Problem; got int"),
    (lambda: sf.estimate(None), TypeError, "problem must be an sf.Problem; several .*estimate_many.*NoneType"),
    (lambda: sf.estimate(PROBLEM, start=[0.5, 9.0]), ValueError, "The start violates k at its upper bound 5"),
    (lambda: samples(values=TWO, names=("a", "a")), ValueError, "names must differ .*; got 'a' twice"),
    (lambda: samples(sigma=1.0, loss="huber", loss_scale=1e200), ValueError, "loss_scale must have a square"),
    (lambda: run(t0=np.timedelta64(1, "s")), TypeError, "t0 must be a number; .*time differences .*not supported"),
    (lambda: sf.HybridSystem({"": decay}, [1.0]), ValueError, "mode names must not be empty"),
    (lambda: sf.Normal(1.0, 1e-200), ValueError, "Normal sd must be positive and finite, and so must its inverse"),
    (lambda: filtered(1e308), ValueError, "lowpass_hz must not need more than 10000000 points, .*; got 1e.308"),
    (lambda: filtered(1e-12), ValueError, "lowpass_hz must be 7.*e-06 or more"),
    (lambda: sf.ReferenceSignal.from_samples(**REFERENCE | HUGE), ValueError, "signal between the .* overflows"),
    (lambda: run(inputs=sf.Input([0, 1], [1e308, -1e308], kind="linear")), ValueError, "signal between the .* ove"),
    (lambda: sf.monte_carlo(PROBLEM, 2, theta=[0.5, 1], noise=lambda *given: "x"), ValueError, "what noise.* 'x'"),
    (lambda: sf.estimate_many([PROBLEM, None]), TypeError, r"problems\[1\] must be an sf.Problem; got NoneType"),
    exact=True,
)
