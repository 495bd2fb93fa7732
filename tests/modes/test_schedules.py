"""Operations on schedules, against schedules written by hand; and their costs, which share one experiment of machine
code.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

import switchfit as sf
from support.mode_libraries import fall, make_library, pull, rise
from switchfit.meshes.evaluator import Evaluator
from switchfit.modes.fitter import Fitter
from switchfit.modes.schedule import (
    Schedule,
    collapse,
    drop_empty,
    list_insertions,
    list_removals,
    list_substitutions,
    merge_neighbours,
    remove_segments,
    space_evenly,
    splice,
    spread,
)
from switchfit.strategy.library import build_library


def schedule(modes, *times):
    return Schedule(tuple(modes), np.array(times, dtype=float), 0.0, 10.0)


def show(found):
    return "".join(found.sequence), found.times.tolist()


FREE = make_library()
CHAIN = make_library("fls", {"f": "l", "l": "s"})


def test_equal_neighbours_become_one():
    assert show(merge_neighbours(schedule("aabbc", 1, 2, 3, 4))) == ("abc", [2.0, 4.0])
    assert show(merge_neighbours(schedule("aaa", 1, 2))) == ("a", [])
    assert show(merge_neighbours(schedule("ab", 1))) == ("ab", [1.0])


@pytest.mark.parametrize(
    ("i", "expected"),
    [(0, ("bca", [4.0, 7.0])), (1, ("aca", [3.0, 7.0])), (2, ("aba", [2.0, 5.5])), (3, ("abc", [2.0, 4.0]))],
)
def test_a_removed_mode_gives_its_time_to_its_neighbours(i, expected):
    """Which become one if they are equal."""
    assert show(remove_segments(schedule("abca", 2, 4, 7), i)) == expected
    assert show(remove_segments(schedule("abac", 2, 4, 7), 1)) == ("ac", [7.0])


def test_modes_of_no_duration_collapse_the_shortest_first():
    assert show(collapse(schedule("abc", 2, 2), FREE, 0.0)) == ("ac", [2.0])
    assert show(collapse(schedule("aba", 2, 2), FREE, 0.0)) == ("a", [])
    assert show(collapse(schedule("abc", 0, 3), FREE, 0.0)) == ("bc", [3.0])
    assert show(collapse(schedule("abc", 3, 10), FREE, 0.0)) == ("ab", [3.0])
    assert show(collapse(schedule("abcb", 3, 3.1, 3.15), FREE, 0.2)) == ("ab", [3.0])
    untouched = schedule("abc", 2, 2.5)
    assert show(collapse(untouched, FREE, 0.4)) == show(untouched)


def test_a_mode_that_the_library_needs_does_not_collapse():
    assert show(collapse(schedule("fls", 2, 2), CHAIN, 0.0)) == ("fls", [2.0, 2.0])
    only_a = make_library(first="a", last="a")
    assert show(collapse(schedule("aba", 0, 5), only_a, 0.0)) == ("aba", [0.0, 5.0])


MODES = st.sampled_from("abc")


@given(st.lists(MODES, min_size=1, max_size=6), st.data())
def test_after_a_pulse_every_moment_has_the_mode_it_should(modes, data):
    times = sorted(data.draw(st.lists(st.floats(0.1, 9.9), min_size=len(modes) - 1, max_size=len(modes) - 1)))
    moments = st.sampled_from([0.0, *times, 10.0]) | st.floats(0.0, 10.0)
    begin, end = sorted((data.draw(moments), data.draw(moments)))
    assume(begin < end)
    mode, given_ = data.draw(MODES), drop_empty(Schedule(tuple(modes), np.array(times), 0.0, 10.0))
    found = splice(given_, mode, begin, end)
    assert all(a != b for a, b in zip(found.sequence, found.sequence[1:], strict=False))
    assert np.all(np.diff(found.knots) > 0)
    for t in np.linspace(0.003, 9.997, 97):
        before = given_.sequence[int(np.searchsorted(given_.times, t, "right"))]
        wanted = mode if begin <= t < end else before
        if min(abs(found.knots - t)) > 1e-9:
            assert found.sequence[int(np.searchsorted(found.times, t, "right"))] == wanted


def test_moves_stay_inside_the_library():
    free, chain = schedule("abca", 2, 4, 7), schedule("fls", 2, 5)
    assert {show(s)[0] for s in list_removals(free, FREE)} == {"bca", "aca", "aba", "abc"}
    assert {show(s)[0] for s in list_removals(chain, CHAIN)} == {"ls", "fl"}
    assert {show(s)[0] for s in list_substitutions(schedule("ab", 2), FREE)} == {"cb", "b", "a", "ac"}
    assert {show(s)[0] for s in list_substitutions(chain, CHAIN)} == {"fl", "ls"}  # one mode twice is one mode
    short = make_library(most=3)
    for found in list_insertions(schedule("ab", 5), short, 5):
        assert short.admits(found.sequence)
        assert show(found) != ("ab", [5.0])


def test_two_modes_go_together_where_neither_may_go_alone():
    pairs = make_library("abc", {"a": "b", "b": "c", "c": "a"}, first="a", last="a")
    assert [show(s) for s in list_removals(schedule("abca", 2, 4, 7), pairs)] == [("a", [])]
    longer = make_library("abc", {"a": "b", "b": "ac", "c": "b"}, first="a")
    assert "ab" in {show(s)[0] for s in list_removals(schedule("abcb", 2, 4, 7), longer)}


def test_schedules_are_moved_apart_and_spaced_by_what_modes_must_last():
    library = make_library(durations={"b": 2.0})
    moved = spread(schedule("abc", 9, 9.5), library)
    assert moved.durations[1] >= 2.0
    assert np.all(moved.durations > 0)
    assert spread(schedule("abab", 1, 2, 3), make_library(durations={"a": 3.0, "b": 3.0})) is None
    even = space_evenly(("a", "b"), 0.0, 10.0, library)
    assert show(even) == ("ab", [4.0])
    assert space_evenly(("b",) * 5, 0.0, 10.0, library) is None


def test_a_library_lists_its_sequences():
    assert [len(list(FREE.list_sequences(k))) for k in range(4)] == [3, 6, 12, 24]
    assert CHAIN.possible_switches == (0, 1, 2)
    only = make_library("fls", {"f": "l", "l": "s"}, first="f", last="s")
    assert only.possible_switches == (2,)
    assert list(only.list_sequences(2)) == [("f", "l", "s")]
    for library in (FREE, CHAIN, only):
        for k in range(library.max_switches + 1):
            assert all(library.admits(sequence) for sequence in library.list_sequences(k))
    assert not FREE.admits("abc" * 4)
    assert not CHAIN.admits("fs")


# Sequences share one experiment of machine code: each evaluates as a problem of its own does


TIMES = np.linspace(0.0, 8.0, 41)


RESETS = {("rise", "fall"): lambda t, x, p: x * jnp.stack([1.0 + 0.1 * t, p["rate"]])}
RATES = {"rise": rise, "fall": fall, "pull": pull}
SEQUENCES = (("rise",), ("rise", "fall"), ("pull", "rise"), ("fall", "rise", "fall"), ("rise", "pull", "fall"))


def make_problem(resets=RESETS, runs=1, prior=None, delay=0.0):
    logs = [
        sf.Measurements(TIMES[5:], np.column_stack([np.sin(TIMES[5:] + k), np.cos(TIMES[5:])]), sigma=0.3, delay=delay)
        for k in range(runs)
    ]
    given = [sf.Experiment(log, ("rise",), (), 0.0, 8.0) for log in logs]
    parameters = {"rate": sf.Parameter(0.8, lower=0.1, upper=3.0, prior=prior), "force": 0.5}
    return sf.Problem(sf.HybridSystem(RATES, [0.2, 1.0], reset_maps=resets), given, parameters)


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
    for given in (  # noqa: F402
        Schedule(("rise",), np.zeros(0), 0.0, 8.0),
        Schedule(("rise", "fall", "rise"), np.array([2.1, 4.0]), 0.0, 8.0),
        Schedule(("rise", "pull", "rise", "fall"), np.array([3.0, 3.0, 5.5]), 0.0, 8.0),  # one without duration
    ):
        times = np.unique(np.concatenate([grid, given.times]))
        pairs = [(begin, end) for k, begin in enumerate(times[:-1]) for end in times[k + 1 :]]
        spliced = [splice(drop_empty(given), mode, *pair) for pair in pairs for mode in library.modes]
        wanted = [each for each in spliced if library.admits(each.sequence) and not is_same(each, given)]
        found = list(list_insertions(given, library, 6))
        assert len(found) == len(wanted) > 0
        assert all(is_same(one, other) for one, other in zip(found, wanted, strict=True))
