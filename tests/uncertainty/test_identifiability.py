"""Identifiability in words: what trades off against what, and what has no effect."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
import scipy.stats

import switchfit as sf
from support.models import STILL
from support.noisy_decays import TIMES, decay, observed, one_line
from switchfit.meshes.evaluator import evaluator_of
from switchfit.uncertainty.identification import Identifiability, analyse

# Identifiability


def test_a_trade_off_in_words_with_its_size_and_what_was_found():
    """y = (a + b) + 0.01 (a - b) t / 6: only the sum is well determined. Only the side that is allowed is tried."""

    def h(t, x, p):
        return jnp.array([p["a"] + p["b"] + 0.01 * (p["a"] - p["b"]) * t])

    problem = observed(h, 30.0 + 0.0 * TIMES, {"a": sf.Parameter(10.0, unit="m"), "b": 20.0}, 0.1)
    for found in (sf.identifiability(problem), sf.estimate(problem).identifiability):
        (direction,) = found.directions
        assert direction.summary in ("a and b trade off", "b and a trade off")
        assert np.sign(direction.change[0]) == -np.sign(direction.change[1])
        assert direction.rises == pytest.approx((found.rise, found.rise), rel=1e-6)  # the model is linear
        assert found.rise == pytest.approx(0.5 * scipy.stats.chi2.ppf(0.95, 1), rel=1e-9)
        moved = f"a {abs(direction.change[0]):.2g} m {'higher' if direction.change[0] > 0 else 'lower'}"
        assert moved in one_line(found)
        assert "or the opposite, raises J by 1.9; noise hides 1.9 (95 %)" in one_line(found)
    evaluate = evaluator_of(problem)
    theta = sf.estimate(problem).theta
    rise = evaluate(theta + direction.change).cost - evaluate(theta).cost
    assert direction.rises[0] == pytest.approx(rise, rel=1e-6)
    held = {"a": sf.Parameter(0.0, lower=0.0), "b": 1.0}
    (direction,) = sf.identifiability(observed(h, 1.0 + 0.0 * TIMES, held, 0.1)).directions
    assert np.isfinite(direction.rises).tolist() == [direction.change[0] >= 0, direction.change[0] < 0]


def test_a_singular_hessian_and_unknowns_without_effect():
    def h(t, x, p):
        return jnp.array([p["a"] * p["b"] * t + 0.0 * p["c"]])

    problem = observed(h, 2.0 * TIMES, {"a": 1.0, "b": 2.0, "c": 3.0}, 0.1)
    for found in (sf.identifiability(problem), sf.identifiability(sf.estimate(problem))):
        assert found.without == ("c",)
        assert found.undetermined == 2
        assert set(found.directions[0].names) == {"a", "b"}
        assert "the cost does not depend on c" in one_line(found)
        assert "do not determine 1 combination of the 3 unknowns" in one_line(found)


def test_twenty_unknowns_over_eight_decades():
    """A quadratic cost: the planted pair is found and named whatever the units of the unknowns are."""
    d = 20
    rng = np.random.default_rng(1)
    size = 10.0 ** rng.uniform(-4, 4, d)
    H = np.eye(d)
    H[4, 11] = H[11, 4] = 0.9999
    H = H / np.outer(size, size)
    theta = 3.0 * size
    names = tuple(f"p{k}" for k in range(d))

    def cost(at):
        return 0.5 * float((at - theta) @ H @ (at - theta))

    about = Identifiability(names, ("",) * d, np.zeros(d, bool), 0.02, "1 % of J", "solution", np.nan)
    found = analyse(about, H, np.eye(d), theta, cost)
    np.testing.assert_allclose(found.eigenvalues[[0, -1]], [1e-4, 1.9999], rtol=1e-6)
    (direction,) = found.directions
    assert set(direction.summary.removesuffix(" trade off").split(" and ")) == {"p4", "p11"}
    assert np.flatnonzero(np.abs(direction.weights) > 1e-6).tolist() == [4, 11]
    # No unknown moves by more than its own size, so that J rises by less than asked for.
    assert np.max(np.abs(direction.change / theta)) <= 1.0 + 1e-12
    assert direction.rises[0] == pytest.approx(cost(theta + direction.change), rel=1e-9)


def test_where_the_valley_bends_the_change_is_shortened():
    H = np.array([[1.0, 0.99], [0.99, 1.0]])

    about = Identifiability(("a", "b"), ("", ""), np.zeros(2, bool), 1.0, "1 % of J", "solution", 100.0)
    found = analyse(about, H, np.eye(2), np.zeros(2), lambda at: 0.5 * at @ H @ at + 10.0 * (at[0] - at[1]) ** 4)
    (direction,) = found.directions
    assert max(direction.rises) <= 2.0
    quadratic = 0.5 * direction.change @ H @ direction.change
    assert quadratic < 0.5
    assert f"raises J by {max(direction.rises):.2g} ({max(direction.rises):.2g} %); 1 % of J is 1" in one_line(found)
    rounded = replace(found, directions=(replace(direction, rises=(-3e-13, -4e-13)),))
    assert "raises J by 0 (0 %)" in one_line(rounded)


def test_before_a_fit_without_sigma_and_without_measurements():
    samples = sf.Measurements(TIMES, 0.0 * TIMES, observe=decay)
    signal = sf.ReferenceSignal.from_samples(TIMES, np.exp(-0.4 * TIMES), observe=decay)
    for data, t0, said in (
        (samples, 0.0, "a change of all that is measured by 1 % of how it varies does"),
        (signal, 0.25, "1 % of J is"),
    ):
        run = sf.Experiment(data, ("still",), (), t0, 6.0)
        assert said in one_line(sf.identifiability(sf.Problem(STILL, run, {"a": 1.0, "k": 0.5})))
