"""Many logs: the same as single estimates, one by one where one needs another mesh or raises."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.heated_rooms import TIMES, TRUTH, measured_room, room
from support.models import slow_guess, temperature
from switchfit.batch import batch
from switchfit.fit.minimization import minimize_cost
from switchfit.meshes.evaluator import evaluator_of

# Many logs


def fit_as_single_ones(problems, rtol):
    """Return the fits of many problems, which must be those of each by itself."""
    fits = sf.estimate_many(problems)
    assert fits.message.tolist() == [""] * len(problems)
    for theta, errors, problem in zip(fits.theta, fits.standard_errors, problems, strict=True):
        single = sf.estimate(problem)
        np.testing.assert_allclose(theta, single.theta, rtol=rtol)
        np.testing.assert_allclose(errors, single.standard_errors, rtol=max(10 * rtol, 1e-6))
    return fits


def test_many_logs_are_the_same_as_single_estimates():
    """Logs of two lengths, one with a missing sample, and two whose horizon is the span of their own data."""
    problems = [room(sf.Measurements(TIMES, measured_room(seed), sigma=0.01)) for seed in range(3)]
    item = problems[1].experiments[0].data[0]
    short = sf.Measurements(item.times[3:16], item.values[3:16], sigma=0.01)
    holes = item.values.copy()
    holes[5] = np.nan
    problems += [room(short), room(replace(item, values=holes))]
    for first in (0.25, 100.0):
        run = sf.Experiment(replace(item, times=item.times - 0.25 + first), ("on", "off"), (first + 1.5,))
        problems.append(replace(problems[0], experiments=run))
    fits = fit_as_single_ones(problems, 1e-8)
    assert fits.samples.tolist() == [24, 24, 24, 13, 23, 24, 24]
    np.testing.assert_allclose(fits.theta[6] - fits.theta[5], [99.75, 0.0], atol=1e-6)


def test_a_log_that_needs_a_finer_mesh_is_done_again_by_itself():
    """The guess is slow and the truth fast: the mesh of the guess is too coarse for one of the logs."""
    problems = [slow_guess(k, 1) for k in (1.0, 12.0, 1.1)]
    fits = fit_as_single_ones(problems, 1e-5)
    on_its_mesh = minimize_cost(evaluator_of(problems[1]), problems[1].initial_theta, "exact", 1e-7, 200)
    assert abs(on_its_mesh.theta[0] - fits.theta[1, 0]) > 1e-5


# What one fit raises does not end the others


def look_up(k):
    if np.any(k > 4.0):
        raise ArithmeticError("the table ends below this k")
    return np.zeros(np.shape(k), np.int32)


def table(k):
    """k itself, by way of a function that JAX cannot see into and that raises an error above 4."""
    shape = jax.ShapeDtypeStruct(k.shape, jnp.int32)
    looked_up = jax.pure_callback(look_up, shape, jax.lax.stop_gradient(k), vmap_method="expand_dims")
    return k + looked_up.astype(k.dtype)


FAILING = sf.HybridSystem({"on": lambda t, x, p: p["h"] - table(p["k"]) * x}, [0.2])


def failing_room(seed, guess):
    """A room that is heated all the time, on coarse meshes: those of most guesses are then padded to the same length,
    and share programs.
    """
    values = temperature(TIMES, 9.0, 1.0, TRUTH[1]) + 0.01 * np.random.default_rng(seed).standard_normal(24)
    run = sf.Experiment(sf.Measurements(TIMES, values, sigma=0.01), ("on",), (), 0.0, 6.0)
    parameters = {"h": guess[0], "k": sf.Parameter(guess[1], lower=0.1, upper=9.0)}
    return sf.Problem(FAILING, run, parameters, rtol=1e-5, atol=1e-7)


def test_a_log_that_raises_an_error_is_listed(monkeypatch, tmp_path):
    monkeypatch.setattr("logging.root.disabled", True)  # what JAX logs about callbacks is not of interest
    problems = [failing_room(seed, guess) for seed, guess in enumerate([(0.9, 1.0), (0.9, 5.0), (1.2, 0.9)])]
    fits = sf.estimate_many(problems, folder=tmp_path)
    assert fits.status.tolist() == ["CONVERGED", "ERROR", "CONVERGED"]
    assert "the table ends below this k" in fits.failures[0][1]
    np.testing.assert_array_equal(fits.start[1], [0.9, 5.0])


def test_an_error_of_the_program_itself_is_said(monkeypatch):
    """It must not pass silently for a model that cannot be evaluated: all fits would take many times as long."""

    def fail(*given, layout):
        raise TypeError("unhashable layout")

    monkeypatch.setattr(batch, "minimize_fits", fail)
    settings = {"theta": TRUTH, "seed": 1}
    with pytest.warns(RuntimeWarning, match=r"failed \(TypeError: unhashable layout\); they are done one by one"):
        study = sf.monte_carlo(room(), 3, **settings)
    monkeypatch.undo()
    np.testing.assert_allclose(study.theta, sf.monte_carlo(room(), 3, **settings).theta, rtol=1e-6)
