"""Sequences of a search share one experiment of machine code: each evaluates as a problem of its own does."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from test_modes import fall, pull, rise

import switchfit as sf
from switchfit.engine.native import program
from switchfit.engine.native.templates import Order
from switchfit.fit.evaluator import Evaluator
from switchfit.modes.fitter import Fitter
from switchfit.modes.schedule import Schedule, list_insertions, space_evenly, splice
from switchfit.strategy.library import build_library

TIMES = np.linspace(0.0, 8.0, 41)


RESETS = {("rise", "fall"): lambda t, x, p: x * jnp.stack([1.0 + 0.1 * t, p["rate"]])}
MODES = {"rise": rise, "fall": fall, "pull": pull}
SEQUENCES = (("rise",), ("rise", "fall"), ("pull", "rise"), ("fall", "rise", "fall"), ("rise", "pull", "fall"))


def make_problem(resets=RESETS, runs=1, prior=None, delay=0.0):
    logs = [
        sf.Measurements(TIMES[5:], np.column_stack([np.sin(TIMES[5:] + k), np.cos(TIMES[5:])]), sigma=0.3, delay=delay)
        for k in range(runs)
    ]
    given = [sf.Experiment(log, ("rise",), (), 0.0, 8.0) for log in logs]
    parameters = {"rate": sf.Parameter(0.8, lower=0.1, upper=3.0, prior=prior), "force": 0.5}
    return sf.Problem(sf.HybridSystem(MODES, [0.2, 1.0], reset_maps=resets), given, parameters)


def make_fitter(problem, **settings):
    library = build_library(problem, max_switches=3, **settings)
    return Fitter(problem, library), library


@pytest.mark.parametrize("durations", [None, {"rise": 0.5}])
def test_derivatives_are_those_of_a_problem_of_its_own(durations):
    """In turn, and back to the first: what one sequence leaves behind does not matter to the next."""
    fitter, library = make_fitter(make_problem(runs=2, prior=sf.Normal(0.9, 0.2)), min_duration=durations)
    for sequence in (*SEQUENCES, *SEQUENCES[::-1]):
        other = SEQUENCES[(SEQUENCES.index(sequence) + 2) % len(SEQUENCES)]
        schedules = [space_evenly(modes, 0.0, 8.0, library) for modes in (sequence, other)]
        shared = fitter.get_evaluator(schedules)
        own = Evaluator(fitter._build_problem(schedules), meshes=fitter.meshes)
        theta = np.concatenate([*(schedule.times + 0.11 for schedule in schedules), [0.7, 0.6]])
        for side in (1, -1):
            one, wanted = shared(theta, side), own(theta, side)
            for name in ("cost", "gradient", "hessian"):
                np.testing.assert_array_equal(getattr(one, name), getattr(wanted, name))
        assert shared.cost(theta) == own.cost(theta)
        assert shared.problem.structures == own.problem.structures
        assert shared.problem.theta_names == own.problem.theta_names
        for name in ("A", "b", "lower", "upper"):
            np.testing.assert_array_equal(getattr(shared.problem.unknowns, name), getattr(own.problem.unknowns, name))


@pytest.mark.parametrize("delay", [0.0, 0.3])
def test_costs_of_many_moves_are_those_of_each(delay):
    fitter, library = make_fitter(make_problem(runs=2, prior=sf.Normal(0.9, 0.2), delay=delay))
    here = [space_evenly(("rise", "fall"), 0.0, 8.0, library), space_evenly(("pull",), 0.0, 8.0, library)]
    for e in (0, 1):
        moved = [*list_insertions(here[e], library, 5), here[e]]
        assert {len(schedule.sequence) for schedule in moved} >= {1, 2, 3}
        alone = []
        for schedule in moved:
            both = [*here[:e], schedule, *here[e + 1 :]]
            alone.append(fitter.cost(both, fitter.start))
            own = Evaluator(fitter._build_problem(both), meshes=fitter.meshes)
            assert alone[-1] == own.cost(np.concatenate([*(each.times for each in both), fitter.start]))
        np.testing.assert_allclose(fitter.compute_costs(here, e, moved, fitter.start), alone, rtol=1e-13)
        assert fitter.cost(here, fitter.start) == alone[-1]  # the experiment is as it was before


def is_same(one, other):
    return one.sequence == other.sequence and np.allclose(one.times, other.times, rtol=0.0, atol=1e-12)


def test_pulses_are_those_that_are_spliced_in():
    _, library = make_fitter(make_problem(), successions={"rise": ["fall", "pull"], "fall": "rise", "pull": "rise"})
    grid = np.linspace(0.0, 8.0, 7)
    for given in (
        Schedule(("rise",), np.zeros(0), 0.0, 8.0),
        Schedule(("rise", "fall", "rise"), np.array([2.1, 4.0]), 0.0, 8.0),
        Schedule(("rise", "pull", "rise", "fall"), np.array([3.0, 3.0, 5.5]), 0.0, 8.0),  # one without duration
    ):
        times = np.unique(np.concatenate([grid, given.times]))
        pairs = [(begin, end) for k, begin in enumerate(times[:-1]) for end in times[k + 1 :]]
        spliced = [splice(given, mode, begin, end) for begin, end in pairs for mode in library.modes]
        wanted = [
            schedule for schedule in spliced if library.admits(schedule.sequence) and not is_same(schedule, given)
        ]
        found = list(list_insertions(given, library, 6))
        assert len(found) == len(wanted) > 0
        assert all(is_same(one, other) for one, other in zip(found, wanted, strict=True))


def test_a_parameter_that_acts_nowhere_needs_no_further_program(monkeypatch):
    """Its derivative is zero, so that a hidden switch is looked for: with the program that the fit has."""
    orders = []
    write = program._write
    monkeypatch.setattr(program, "_write", lambda *given: (orders.append(given[2]), write(*given))[1])
    program.drop_programs()
    system = sf.HybridSystem({"rise": rise, "fall": fall}, [0.2, 1.0])
    log = sf.Measurements(TIMES[1:], np.column_stack([np.sin(TIMES[1:]), np.cos(TIMES[1:])]), sigma=0.3)
    run = sf.Experiment(log, ("rise", "fall"), (3.0,), 0.0, 8.0)
    sf.estimate(sf.Problem(system, run, {"rate": 0.8, "unused": 2.0}), strategy="local")
    assert orders == [Order.COST, Order.HESSIAN]
