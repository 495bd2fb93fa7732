"""Rows against a construction in plain Python; the nodes of a problem; adaptive steps."""

from functools import cache
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

import switchfit as sf
from support import models
from switchfit.discretization import rows, step_size
from switchfit.discretization.arguments import build_arguments
from switchfit.discretization.mesh import Mesh, build_rows, find_row_ending_cell, pad_length
from switchfit.discretization.step_size import Tolerances
from switchfit.discretization.tableaus import ADAPTIVE_ERROR
from switchfit.engine.adaptive import integrator
from switchfit.engine.adaptive import steps as steps_module
from switchfit.engine.adaptive.stiffness import Watch
from switchfit.engine.native.native_experiment import native_experiment
from switchfit.engine.run import runs_of
from switchfit.meshes.refinement import refine_mesh
from switchfit.problem.functions import use_float64

# Rows


def walk(nodes, tau, side):
    """The rows as (segment, cell, start, end): nodes and transition times in order, and what lies between them.

    A transition time that equals a node comes after it (side 1) or before it (side -1), but never outside the nodes:
    all padding at the end counts as the last node.
    """
    last = int(np.searchsorted(nodes, nodes[-1]))
    marks = [(-np.inf if k == 0 else np.inf if k >= last else t, 0, 1, 0) for k, t in enumerate(nodes)]
    marks += [(t, side, 0, 1) for t in tau]
    times = [*nodes, *tau]
    order = sorted(range(len(marks)), key=lambda m: (marks[m][:2], m))
    found, cell, segment = [], -1, 0
    for here, following in pairwise(order):
        cell, segment = cell + marks[here][2], segment + marks[here][3]
        found.append((segment, cell, times[here], times[following]))
    return found


@cache
def program(cells, transitions):
    return jax.jit(
        lambda nodes, tau, side: (
            rows := build_rows(nodes, tau, side),
            find_row_ending_cell(rows.first_cell, jnp.arange(-1, cells)),
        )
    )


def layout_of(nodes, tau, side):
    with use_float64():
        found = program(len(nodes) - 1, len(tau))(jnp.asarray(nodes), jnp.asarray(tau, float), side)
    return jax.tree.map(np.asarray, found)


@st.composite
def cuts(draw):
    """Nodes, some of them repeated at the end as padding, transition times in all kinds of places, and a side."""
    cells, transitions = draw(st.sampled_from([(1, 2), (7, 0), (7, 1), (7, 4), (40, 5)]))
    lengths = draw(st.lists(st.floats(1e-9, 10.0), min_size=cells, max_size=cells))
    nodes = draw(st.floats(-100.0, 100.0)) + np.concatenate([[0.0], np.cumsum(lengths)])
    used = draw(st.integers(1, cells))
    nodes[used:] = nodes[used]
    places = []
    for _ in range(transitions):
        node = nodes[draw(st.integers(0, used))]
        kind = draw(st.sampled_from(["node", "before", "after", "between", "again"]))
        place = {
            "node": node,
            "before": np.nextafter(node, -np.inf),
            "after": np.nextafter(node, np.inf),
            "between": nodes[0] + draw(st.floats(0.0, 1.0)) * (nodes[-1] - nodes[0]),
            "again": places[-1] if places else node,
        }[kind]
        places.append(np.clip(place, nodes[0], nodes[-1]))
    return nodes, np.sort(places), draw(st.sampled_from([1, -1]))


SEVEN = np.arange(8.0)


@given(cuts())
@example((SEVEN, np.array([2.0]), 1))
@example((SEVEN, np.array([2.0]), -1))
@example((SEVEN, np.array([3.0, 3.0, 3.5, 3.5]), 1))
@example((SEVEN, np.array([3.0, 3.0, 3.5, 3.5]), -1))
def test_rows_against_a_walk_along_the_time_axis(cut):
    nodes, tau, side = cut
    layout, ending = layout_of(nodes, tau, side)
    expected = walk(nodes, tau, side)
    assert list(zip(layout.segment, layout.cell, layout.start, layout.end, strict=True)) == expected

    # Where each segment begins, and where reset maps act.
    segments = [segment for segment, *_ in expected]
    first_row = [segments.index(k) for k in range(len(tau) + 1)]
    np.testing.assert_array_equal(layout.first_row, first_row)
    np.testing.assert_array_equal(layout.first_cell, layout.cell[first_row])
    np.testing.assert_array_equal(np.flatnonzero(layout.opens), first_row[1:])

    # Time runs on from row to row without gaps, padding included.
    np.testing.assert_array_equal([*layout.start, nodes[-1]], [nodes[0], *layout.end])
    assert np.all(layout.end >= layout.start)

    last_in_cell = {cell: row for row, (_, cell, *_) in enumerate(expected)}
    np.testing.assert_array_equal(ending, [-1, *(last_in_cell[c] for c in range(len(nodes) - 1))])


@given(st.lists(st.integers(0, 60), min_size=2).filter(lambda times: min(times) < max(times)))
def test_mesh_of_times_in_any_order(times):
    mesh = Mesh.from_times(np.array(times) / 7.0)
    assert mesh.times.tolist() == sorted({t / 7.0 for t in times})
    assert len(mesh.nodes) == pad_length(mesh.cells) + 1
    assert np.all(mesh.nodes[mesh.cells :] == mesh.times[-1])


# The adaptive solve


def swinging(t, x, p, u):
    return jnp.array([x[1], -4.0 * x[0] + u - 0.3 * x[1] ** 3])


def test_both_engines_take_the_steps_of_scipy():
    """Those of machine code and those of Python.

    Also across the knots of a reference signal, from rest (a first step of its own kind) and in two modes.
    """
    times = np.linspace(0.0, 6.0, 14)
    signal = sf.ReferenceSignal.from_samples(times, np.sin(times)).signal
    system = sf.HybridSystem({"a": swinging, "b": lambda t, x, p, u: jnp.array([-x[0], -8.0 * x[1]])}, [0.0, 0.0])
    inputs = sf.Input([0.0, 2.5, 6.0], [0.0, 3.0, -1.0], kind="linear")
    data = sf.ReferenceSignal(signal, observe=models.first_state)
    run = sf.Experiment(data, ("a", "b", "a"), (1.7, 2.9), 0.0, 6.0, inputs=inputs)
    problem = sf.Problem(system, run)
    coarse = Mesh.of(run)
    native = native_experiment(problem.structures[0], build_arguments(problem, 0, coarse), coarse.times, 0)
    solve = integrator.Integrator(runs_of(problem)[0], problem.structures[0], coarse, integrator.SolveSettings())
    tolerances = Tolerances(problem.rtol, problem.atol)

    def steps_of_scipy(mode, start, end, x):
        def slope(t, y):
            inside = min(max(t, np.nextafter(start, end)), np.nextafter(end, start))
            cells = np.array([min(int(coarse.times.searchsorted(inside, "right")), coarse.cells) - 1])
            return native.slopes_in(mode, np.array([t]), y[None], np.zeros(0), cells)[0]

        found = solve_ivp(slope, (start, end), [*x, 0.0], "RK45", rtol=problem.rtol, atol=problem.atol)
        return found.t[1:], found.y[:-1, -1]

    for mode, start, end, x in ((0, 0.0, 1.7, [0.0, 0.0]), (1, 1.7, 2.5, [0.4, 1.0]), (0, 2.9, 6.0, [0.1, -0.2])):
        expected, state = steps_of_scipy(mode, start, end, x)
        with use_float64():
            stretch = steps_module.Stretch(mode, start, end, np.array(x))
            natively = steps_module.NativeSteps(native, mode, stretch, np.zeros(0), tolerances)
            in_python = steps_module.PythonSteps(solve._build_slope(stretch, mode), stretch, tolerances)
            found = [solve._take_steps(stretch, steps, Watch()) for steps in (natively, in_python)]
        for steps, after, crossing in found:
            assert crossing is None
            assert len(steps) == len(expected) > 10
            np.testing.assert_allclose(steps, expected, rtol=0, atol=1e-4 * (end - start))
            np.testing.assert_allclose(after, state, rtol=0, atol=1e-8)


def test_the_last_step_ends_at_the_end_and_one_shorter_than_rounding_is_stuck():
    good, y, tolerances = np.zeros((len(ADAPTIVE_ERROR), 1)), np.zeros(1), Tolerances(1e-8, 1e-9)

    def judge_step(t, step, end, slopes):
        at = step_size.Progress(t, step, False, False)
        errors = step * rows.combine(ADAPTIVE_ERROR, slopes)
        return step_size.judge_error(at, end, tolerances, y, y, errors, step_size.EXPONENT, np)[0]

    with np.errstate(divide="ignore"):
        third, bad = 1.0 / 3.0, good + 1e100
        assert judge_step(third, step_size.limit_step(third, 5.0, 0.7), 0.7, good).t == 0.7
        assert judge_step(1.0, 3e-15, 2.0, bad).stuck
        assert not judge_step(1.0, 1e-12, 2.0, bad).stuck
        assert judge_step(1.0, np.nan, 2.0, good).stuck
        assert 1.0 + judge_step(1.0, 1e-30, 2.0, good).step > 1.0, "a step after an accepted one changes t"


def test_a_mesh_for_several_thetas_is_as_dense_as_the_densest():
    modes = {"fast": lambda t, x, p: -40.0 * (x - jnp.cos(9 * t)), "slow": lambda t, x, p: -0.1 * x}
    run = sf.Experiment(sf.RunningCost(lambda t, x, p: x[0] ** 2), ("fast", "slow"), (1.0,), 0.0, 10.0)
    problem = sf.Problem(sf.HybridSystem(modes, [1.0]), run)
    early, late = np.array([1.0]), np.array([8.0])
    counts = [refine_mesh(problem, 0, *thetas).cells for thetas in ((early,), (late,), (early, late), (late, early))]
    assert counts[0] < 0.3 * counts[1]
    assert counts[1] <= counts[2] == counts[3] <= counts[1] + counts[0]
    assert refine_mesh(problem, 0, early, finer=2.0).cells == pytest.approx(2 * counts[0], rel=0.1)


@pytest.mark.parametrize("parts", [2, 3, 5])
@pytest.mark.parametrize("nodes", [[1.0, np.nextafter(1.0, 2.0), 2.0], [0.0, 0.3, 1.0]], ids=["rounding", "plain"])
def test_equal_parts_of_a_cell_as_short_as_rounding_are_one(parts, nodes):
    mesh = Mesh.from_times(np.array(nodes)).divide(parts)
    ends = {a + (b - a) * k / parts for a, b in pairwise(nodes) for k in range(parts)}
    np.testing.assert_array_equal(mesh.times, sorted({*ends, nodes[-1]}))
    assert mesh.cells == len(mesh.times) - 1
