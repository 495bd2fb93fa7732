"""Inputs, reference signals and measurements: what they add to the cost, in closed form."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import Polynomial

import switchfit as sf
from support.models import one_run, rest

# Inputs


INTEGRATOR = sf.HybridSystem({"on": lambda t, x, p, u: jnp.array([p["gain"] * u, x[0]])}, [0.0, 0.0])
"""The first state integrates the input times p, the second one integrates the first."""

FINAL_STATE = sf.TerminalCost(lambda x, p: x[0] + 2.0 * x[1])
KNOTS = np.array([-0.5, 0.3711, 0.9, 1.7071, 2.0])
LEVELS = np.array([2.0, -1.0, 4.0, 0.5, 7.0])
CUBIC = Polynomial([1.0, -2.0, 0.7, 0.4])


def integral_of(pieces):
    """p (int u + 2 int int u) over [0, 2] = p int u (1 + 2 (2 - t)) with p = 1.5; pieces: (from, to, polynomial)."""
    weighted = [(a, b, (u * Polynomial([5.0, -2.0])).integ()) for a, b, u in pieces]
    return 1.5 * sum(U(b) - U(a) for a, b, U in weighted)


def line(a, b, at_a, at_b):
    return Polynomial([at_a, (at_b - at_a) / (b - a)])(Polynomial([-a, 1.0]))


CLIPPED = np.clip(KNOTS, 0.0, 2.0)
CELLS = [(CLIPPED[k], CLIPPED[k + 1]) for k in range(4)]
LINES = [line(KNOTS[k], KNOTS[k + 1], LEVELS[k], LEVELS[k + 1]) for k in range(4)]
STEP = [(0.0, 0.5, Polynomial([1.0])), (0.5, 2.0, Polynomial([3.0]))]
INPUTS = {
    "hold": (sf.Input(KNOTS, LEVELS), [(a, b, Polynomial([u])) for (a, b), u in zip(CELLS, LEVELS[:4], strict=True)]),
    "linear": (sf.Input(KNOTS, LEVELS, kind="linear"), [(a, b, u) for (a, b), u in zip(CELLS, LINES, strict=True)]),
    "cubic": (sf.Input(KNOTS, CUBIC(KNOTS), kind="cubic"), [(0.0, 2.0, CUBIC)]),
    "its last value is kept": (sf.Input([0.0, 0.5], [1.0, 3.0]), STEP),
}


@pytest.mark.parametrize(("inputs", "pieces"), INPUTS.values(), ids=INPUTS)
def test_inputs_are_integrated_exactly_since_no_step_crosses_a_knot(inputs, pieces):
    """Any step across the jump at 0.3711 would leave an error of the step length or of its square."""
    run = sf.Experiment(FINAL_STATE, ("on",), (), 0.0, 2.0, inputs=inputs)
    found, expected = sf.evaluate(sf.Problem(INTEGRATOR, run, {"gain": 1.5})), integral_of(pieces)
    assert found.cost == pytest.approx(expected, rel=1e-13)
    assert found.gradient[0] == pytest.approx(expected / 1.5, rel=1e-13)


# Reference signals


IRREGULAR = np.array([0.0, 0.1, 0.35, 0.4, 0.9, 1.2, 1.25, 1.8, 2.0])
DENSE = np.linspace(0.0, 2.0, 301)
OTHER = Polynomial([0.3, 0.5, -1.0, 0.25])


def two_cubics(times):
    return np.stack([CUBIC(times), OTHER(times)], axis=1)


def test_times_with_a_missing_value_are_left_out():
    """A cubic comes back whole."""
    values = two_cubics(IRREGULAR)
    values[[0, 3], 0] = values[[2, 3], 1] = np.nan
    reference = sf.ReferenceSignal.from_samples(IRREGULAR, values)
    np.testing.assert_allclose(reference.signal(DENSE), two_cubics(DENSE), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(reference.samples[0], np.delete(IRREGULAR, [0, 2, 3]))


def test_a_time_given_twice_breaks_the_signal():
    """A cubic up to t = 0.9 and another one from there, with neither of them bent near the break."""
    before, after = IRREGULAR[:5], IRREGULAR[4:]
    values = np.concatenate([CUBIC(before), OTHER(after)])
    signal = sf.ReferenceSignal.from_samples(np.concatenate([before, after]), values).signal
    expected = np.where(DENSE < 0.9, CUBIC(DENSE), OTHER(DENSE))
    np.testing.assert_allclose(signal(DENSE)[:, 0], expected, rtol=0, atol=1e-13)
    assert signal([0.9])[0, 0] == pytest.approx(OTHER(0.9), abs=1e-13)
    assert signal([np.nextafter(0.9, 0.0)])[0, 0] == pytest.approx(CUBIC(0.9), abs=1e-13)


def filtered(frequency, cutoff):
    """Amplitudes of the sine and of the cosine that remain of a sine, far from the ends."""
    times = np.linspace(0.0, 40.0, 2001)
    signal = sf.ReferenceSignal.from_samples(times, np.sin(2 * np.pi * frequency * times), lowpass_hz=cutoff).signal
    middle = np.arange(15.0, 25.0, 0.005)
    y = signal(middle)[:, 0]
    return [2 * np.mean(y * wave(2 * np.pi * frequency * middle)) for wave in (np.sin, np.cos)]


@pytest.mark.parametrize(
    ("frequency", "cutoff", "amplitude", "tolerances"),
    [(0.2, 2.0, 1.0, (1e-3, 1e-5)), (1.0, 1.0, 0.5, (5e-3, 5e-3)), (10.0, 1.0, 0.0, (1.4e-4, 1.4e-4))],
    ids=["passes", "half at its cut-off", "stops"],
)
def test_the_lowpass_filter_keeps_the_phase(frequency, cutoff, amplitude, tolerances):
    np.testing.assert_array_less(np.abs(filtered(frequency, cutoff) - np.array([amplitude, 0.0])), tolerances)


REST = sf.HybridSystem({"rest": rest}, lambda p: jnp.array([0.4, p["level"]]))


def reference_cost(values=None, times=IRREGULAR, **settings):
    """J of a state that stays at (0.4, p) for a reference on [0, 2]."""
    values = two_cubics(times) if values is None else values
    signal = sf.ReferenceSignal.from_samples(times, values, **settings)
    return sf.evaluate(sf.Problem(REST, sf.Experiment(signal, ("rest",), (), 0.0, 2.0), {"level": -0.2}))


@pytest.mark.parametrize(
    ("weights", "W"),
    [(None, np.eye(2)), ([2.0, 0.5], np.diag([2.0, 0.5])), ([[2.0, -0.6], [-0.6, 0.5]],) * 2],
    ids=["none", "diagonal", "matrix"],
)
def test_weights_of_a_reference_signal(weights, W):
    """J = 1/2 int (y - y_m)' W (y - y_m), a polynomial; dJ/dlevel = int W[1] (y - y_m)."""
    W = np.array(W)
    r = [0.4 - CUBIC, -0.2 - OTHER]
    density = sum(0.5 * W[i, j] * r[i] * r[j] for i in range(2) for j in range(2)).integ()
    slope = (W[1, 0] * r[0] + W[1, 1] * r[1]).integ()
    found = reference_cost(weights=weights)
    assert found.cost == pytest.approx(density(2.0) - density(0.0), rel=1e-7)
    assert found.gradient[0] == pytest.approx(slope(2.0) - slope(0.0), rel=1e-7)
    assert found.hessian[0, 0] == pytest.approx(2.0 * W[1, 1], rel=1e-12)


def test_a_broken_reference_signal_is_integrated_up_to_the_break_and_from_it():
    """0 before t = 0.7 and 1 after it: evenly spaced nodes or a smooth signal would miss that."""
    times = np.array([0.0, 0.2, 0.5, 0.7, 0.7, 0.9, 1.5, 2.0])
    values = np.repeat(np.array([[0.0, 0.0], [1.0, 1.0]]), 4, axis=0)
    before, after = 0.5 * (0.4**2 + 0.2**2), 0.5 * (0.6**2 + 1.2**2)
    assert reference_cost(values, times).cost == pytest.approx(0.7 * before + 1.3 * after, rel=1e-13)


# Measurements


def test_a_sample_at_a_transition_with_a_reset_map_is_of_the_state_before_the_jump():
    """x = 1, halved at tau = 0.5, where a sample is: the cost is that of the 1, whatever the side of tau."""
    system = sf.HybridSystem({"a": rest}, [1.0], {("a", "a"): lambda t, x, p: p["e"] * x})
    problem = one_run(system, sf.Measurements([0.5, 1.0], [0.0, 0.0]), ("a", "a"), (0.5,), 1.0, {"e": 0.5})
    found = sf.evaluate(problem)
    assert found.cost == pytest.approx(0.5 * (1.0 + 0.25), rel=1e-14)
    assert found.gradient[1] == pytest.approx(0.5, rel=1e-14)


def test_costs_of_several_data_add_up():
    """Two Measurements, a reference and running and terminal costs at once, each with a cost of its own size."""
    system = sf.HybridSystem({"a": rest}, lambda p: jnp.array([p["c"]]))
    data = [
        sf.Measurements([0.5], [0.0], sigma=0.1),
        sf.RunningCost(lambda t, x, p: 3.0 * x[0]),
        sf.Measurements([0.2, 0.4], [0.0, 1.0], observe=lambda t, x, p: 10.0 * x),
        sf.TerminalCost(lambda x, p: 7.0 * x[0]),
        sf.ReferenceSignal.from_samples([0.0, 1.0, 2.0, 3.0], [1.0, 1.0, 1.0, 1.0], weights=[11.0]),
        sf.ReferenceSignal.from_samples([0.0, 1.0, 2.0, 3.0], [2.0, 2.0, 2.0, 2.0], observe=lambda t, x, p: -x),
    ]
    found = sf.evaluate(sf.Problem(system, sf.Experiment(data, ("a",), (), 0.0, 2.0), {"c": 0.3}))
    c = 0.3
    parts = [50 * c**2, 6 * c, 50 * c**2 + 0.5 * (10 * c - 1) ** 2, 7 * c, 11 * (c - 1) ** 2, (c + 2) ** 2]
    slopes = [100 * c, 6, 100 * c + 10 * (10 * c - 1), 7, 22 * (c - 1), 2 * (c + 2)]
    assert found.cost == pytest.approx(sum(parts), rel=1e-13)
    assert found.gradient[0] == pytest.approx(sum(slopes), rel=1e-13)


# The horizon where t0 or tf is left out


def ones(times, **settings):
    return sf.Measurements(times, np.ones(len(times)), **settings)


def reference_over(*times):
    return sf.ReferenceSignal.from_samples(times, np.ones(len(times)))


@pytest.mark.parametrize(
    ("data", "given", "horizon"),
    [
        (ones([1.0, 2.0, 3.0]), {}, (1.0, 3.0)),
        (ones([1.0, 2.0, 3.0]), {"t0": 0.5}, (0.5, 3.0)),
        (ones([1.0, 2.0, 3.0]), {"tf": 7.0}, (1.0, 7.0)),
        (ones([1.0, 2.0, 3.0], delay=0.25), {}, (0.75, 2.75)),
        (reference_over(-1.0, 0.0, 1.0, 4.0), {}, (-1.0, 4.0)),
        ([ones([1.0, 2.0]), FINAL_STATE, ones([1.5, 2.5])], {}, (1.0, 2.5)),
        ([ones([0.5, 2.0]), reference_over(0.0, 1.0, 2.0, 3.0)], {}, (0.0, 3.0)),
    ],
)
def test_a_horizon_that_is_left_out_is_the_span_of_the_data(data, given, horizon):
    run = sf.Experiment(data, ("a", "b"), (1.75,), **given)
    assert (run.t0, run.tf) == horizon
    assert run.taken_from_data == tuple(name for name in ("t0", "tf") if given.get(name) is None)
    assert sf.Experiment(data, ("a", "b"), None, **given).initial_times[0] == pytest.approx(np.mean(horizon))


def test_a_copy_with_other_data_keeps_the_horizon_unless_it_is_left_out_again():
    run = sf.Experiment(ones([1.0, 2.0, 3.0]), ("a",), ())
    kept = replace(run, data=ones([1.5, 2.0]))
    assert (kept.t0, kept.tf, kept.taken_from_data) == (1.0, 3.0, ())
    anew = replace(run, data=ones([1.5, 2.0]), t0=None, tf=None)
    assert (anew.t0, anew.tf) == (1.5, 2.0)
