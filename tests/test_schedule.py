"""Operations on schedules, against schedules written by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from switchfit.modes.schedule import (
    Schedule,
    collapse,
    list_insertions,
    list_removals,
    list_substitutions,
    merge_neighbours,
    remove_segments,
    space_evenly,
    splice,
    spread,
)
from switchfit.strategy.library import Library


def make_library(modes="abc", successions=None, most=8, durations=None, first=None, last=None):
    names = tuple(modes)
    followers = {m: tuple(n for n in names if n != m) for m in names} if successions is None else successions
    followers = {m: tuple(followers.get(m, ())) for m in names}
    lasting = {m: (durations or {}).get(m, 0.0) for m in names}
    return Library(names, tuple(first or names), tuple(last or names), followers, lasting, most)


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
    assert show(remove_segments(schedule("abca", 2, 4, 7), i)) == expected


def test_removal_between_two_equal_modes_joins_them():
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
    mode, given_ = data.draw(MODES), Schedule(tuple(modes), np.array(times), 0.0, 10.0)
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
