"""Searches for the mode sequence in measured logs whose answer is known; that of fishing is in test_examples.py."""

import runpy
import sys
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from switchfit.io.problem_file import load_problem

EXAMPLES = Path(__file__).parent.parent / "examples"


def flight(t, x, p):
    speed, heading = x[2], x[3]
    return jnp.stack([speed * jnp.cos(heading), speed * jnp.sin(heading), 0.0 * speed, 0.0 * speed])


def make_toss(number):
    """A toss of the cube, with "flight" in the library; a single mode is the first guess."""
    example = runpy.run_path(str(EXAMPLES / "tosses" / "tosses.py"))
    given = example["make_problem"]([example["read"]()[number]])
    modes = {"flight": flight, **given.system.modes}
    cube = sf.HybridSystem(modes, given.system.initial_state, state_names=given.system.state_names)
    run = replace(given.experiments[0], mode_sequence=("slide",), transition_times=())
    return sf.Problem(cube, run, given.parameters), given


@pytest.mark.slow
@pytest.mark.parametrize("number", range(10))
def test_a_toss_slides_and_sticks(number):
    """With successions it is what the cube did; without, BIC as it stands wants more, and nothing is found."""
    problem, known = make_toss(number)
    found = sf.find_modes(problem, successions={"flight": "slide", "slide": "stick"}, max_switches=6)
    assert found.mode_sequence == ("slide", "stick")
    assert found.status in (sf.ModeStatus.FOUND, sf.ModeStatus.AMBIGUOUS)
    assert found.best.cost <= sf.estimate(known).cost * (1 + 1e-6)
    free = sf.find_modes(problem, max_switches=6)
    assert free.status is sf.ModeStatus.AMBIGUOUS
    assert min(free.fitted, key=lambda fit: fit.bic).switches > 1
    correlated = any(warning.kind == "correlated residuals" for warning in free.warnings)
    assert correlated == any(warning.kind == "discounted" for warning in free.warnings)


@pytest.mark.slow
def test_the_spreading_rate_changed_three_times():
    loaded = load_problem(EXAMPLES / "covid" / "search.toml", searched=True)
    search = sf.find_modes(loaded.problem, max_switches=5, **loaded.library)
    assert search.success
    assert search.mode_sequence == ("phase 0", "phase 1", "phase 2", "phase 3")
    rows = {name: [getattr(fit, name) for fit in search.fitted] for name in ("bic", "mbic", "aicc")}
    assert [fit.switches for fit in search.fitted] == [0, 1, 2, 3, 4, 5]
    assert {name: int(np.argmin(values)) for name, values in rows.items()} == {"bic": 3, "mbic": 3, "aicc": 3}
    # Of another implementation, which does not count the noise: log 51 less.
    expected = np.array([315.6, 228.6, 212.7, 196.1]) + np.log(51)
    np.testing.assert_array_less(rows["bic"][:4], expected + 1.0)
    module = runpy.run_path(str(EXAMPLES / "covid" / "covid.py"))
    known = sf.estimate(module["make_problem"]())
    np.testing.assert_allclose(search.best.cost, known.cost, rtol=1e-6)
    np.testing.assert_allclose(search.transition_times[0], known.transition_times[0], atol=1e-3)


def test_the_counts_of_the_problem_file_are_those_of_the_example():
    """Their square roots, at noon of the day of infection."""
    module = runpy.run_path(str(EXAMPLES / "covid" / "covid.py"))
    known = module["make_problem"]().experiments[0]
    run = load_problem(EXAMPLES / "covid" / "search.toml", searched=True).problem.experiments[0]
    assert (run.t0, run.end, run.origin) == (known.t0, known.end, known.origin)
    np.testing.assert_allclose(run.data[0].times, known.data[0].times, atol=1e-12)
    np.testing.assert_allclose(run.data[0].values, known.data[0].values, rtol=1e-9)


@pytest.fixture(scope="module")
def heaters():
    sys.path.insert(0, str(EXAMPLES / "heaters"))
    try:
        order = runpy.run_path(str(EXAMPLES / "heaters" / "order.py"))
    finally:
        sys.path.remove(str(EXAMPLES / "heaters"))
    example = order["heaters"]
    return order, sf.estimate(example.make_problem("power")), tuple(example.MODES)


def get_fit(search, switches):
    return next(fit for fit in search.fitted if fit.switches == switches)


@pytest.mark.slow
def test_the_order_of_the_heaters_is_found_one_heater_at_a_time(heaters):
    order, known, modes = heaters
    search = order["search"](first="0/0", successions=order["one_at_a_time"]())
    assert search.mode_sequence == modes
    np.testing.assert_allclose(search.best.cost, known.cost, rtol=1e-6)
    np.testing.assert_allclose(search.transition_times[0], known.transition_times[0], atol=0.02)
    assert search.status is sf.ModeStatus.NOT_EXPLAINED
    eight = get_fit(search, 8)
    assert eight.bic < search.chosen[0].bic - 40.0, "as they stand, the criteria want two crutches"
    assert search.chosen[0].weight > 0.9
    assert [warning.switches for warning in search.warnings if warning.kind == "discounted"] == [6]


@pytest.mark.slow
def test_the_free_library_of_the_heaters_is_never_called_found(heaters):
    """Settings with powers of their own are interchangeable: at best J is right, and the names are not."""
    order, known, _ = heaters
    search = order["search"]()
    assert not search.success
    assert search.status in (sf.ModeStatus.NOT_EXPLAINED, sf.ModeStatus.AMBIGUOUS)
    assert get_fit(search, 6).cost < 1.01 * known.cost
