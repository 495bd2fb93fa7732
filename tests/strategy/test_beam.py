"""The prefix beam: its costs and derivatives against the evaluator, its rules, and what it finds."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from benchmarks.modes.truths import three_modes
from support.mode_libraries import make_library
from switchfit.discretization.mesh import Mesh
from switchfit.engine.hypotheses import Column, Hypotheses
from switchfit.meshes.evaluator import Evaluator
from switchfit.modes.schedule import Schedule, collapse
from switchfit.strategy import beam as beams
from switchfit.strategy.beam_grid import build_mesh, choose_grid, choose_stops, count_values
from switchfit.strategy.sequences import Rules, select_lowest

# A system with everything that a beam can follow


MODES = {
    "swing": lambda t, x, p, u: jnp.stack([x[1], -p["k"] * jnp.sin(x[0]) - 0.3 * x[1] + u]),
    "drift": lambda t, x, p, u: jnp.stack([p["v"] - 0.2 * x[0] ** 2, jnp.cos(t) - p["k"] * x[1]]),
    "brake": lambda t, x, p, u: jnp.stack([x[1] * 0.5, -p["v"] * x[1] + 0.1 * x[0] + 0.2 * u]),
}


def bounce(t, x, p):
    return jnp.stack([x[0] + 0.1 * jnp.sin(t), -0.7 * x[1] * p["k"]])


SEQUENCE, TIMES = ("swing", "drift", "brake"), (1.2, 2.4)
FIRST = np.array([0.0, 0.4, 0.8, 1.2, 1.6, 2.0, 2.4, 2.8, 3.2, 3.6, 4.0])
SECOND = np.array([0.3, 1.1, 1.9, 2.7, 3.5])


def everything(running=True, solver="auto", **more):
    """A problem with inputs, a reset map, an unknown initial state, sensors at different times, a robust loss, an
    unknown sigma, and costs at samples, along the way, at transitions and at the end.
    """
    rng = np.random.default_rng(3)
    values = rng.normal(size=(len(FIRST), 2))
    values[3, 0] = values[5] = np.nan
    slow = sf.Measurements(FIRST, values, sigma=[0.3, 0.5])
    squared = rng.normal(size=(len(SECOND), 1))
    fast = sf.Measurements(SECOND, squared, lambda t, x, p: x[:1] ** 2 + p["v"], sigma=0.2, loss="soft_l1")
    noisy = sf.Measurements([0.6, 1.4, 3.0], rng.normal(size=(3, 1)), observe=lambda t, x, p: x[1:], sigma="s")
    follow = sf.ReferenceSignal.from_samples(np.linspace(0.0, 4.0, 9), rng.normal(size=(9, 2)), lowpass_hz=0.4)
    at_transitions = sf.TransitionCost(lambda t, x, p: 0.3 * x[0] ** 2 * t + p["v"], before="swing")
    along_the_way = [follow, sf.RunningCost(lambda t, x, p: 0.1 * p["k"] * x[0] ** 2)] if running else []
    at_the_end = sf.TerminalCost(lambda x, p: p["k"] * x[1] ** 2)
    given = {"data": [slow, fast, noisy, at_transitions, at_the_end, *along_the_way]} | more
    bounces = {("swing", "drift"): bounce, ("drift", "brake"): bounce}
    system = sf.HybridSystem(MODES, [sf.Parameter(0.5), 0.2], bounces)
    inputs = sf.Input([0.0, 1.0, 2.2, 4.0], [0.1, 0.5, -0.3, 0.0], kind="hold")
    run = sf.Experiment(mode_sequence=SEQUENCE, transition_times=TIMES, t0=0.0, tf=4.0, inputs=inputs, **given)
    parameters = {"k": sf.Parameter(1.3, lower=0.2), "v": 0.6, "s": sf.Parameter(0.4, lower=0.01)}
    return sf.Problem(system, run, parameters, solver=solver)


def beam(problem, library, *, penalty, width):
    """Return the proposals of a beam over the only run."""
    track = beams.prepare(problem, 0, library, None)
    return track.run(Rules.of(library, track.modes), problem.initial_theta, penalty, width, beams.REPLAYS, None)


def without_priors(D):
    """The start of one hypothesis with D unknowns."""
    one, rows = np.zeros(1), np.zeros((1, D))
    return Hypotheses(one, one, rows, np.zeros((1, D, D)), rows, one, one)


def begin_at(problem, grid):
    """Prepare a beam without priors that does not move its point of linearisation; return it, its state at t0 and p."""
    track = beams.prepare(problem, 0, make_library(SEQUENCE, most=2), grid)
    D = track.births + len(track.places)
    p = problem.initial_theta[len(problem.initial_theta) - len(problem.parameters) - 1 :][track.own[track.places]]
    return track, track.engine.begin(p, without_priors(D), (1e300, 1.0, 0.0), None), p  # one step a cell


def follow_schedule(problem, grid):
    """Propagate `SEQUENCE` and `TIMES`, without priors and with a fixed point of linearisation; return J, g, H."""
    track, states, _ = begin_at(problem, grid)
    nodes = [0, *np.searchsorted(track.times, TIMES).tolist(), len(track.times) - 1]
    for i, (first, last) in enumerate(pairwise(nodes)):
        before = max(i - 1, 0)
        child = np.full((1, len(Column)), -1, dtype=np.int64)
        child[0, :4] = 0, before, i, i - 1
        child[0, beams.FUNCTION_COLUMNS] = track.functions[:, before, i]
        states = track.engine.advance(states, child, first, last)
    own = np.append(np.arange(len(TIMES)), track.births + np.arange(len(track.places)))
    return track, states.costs[0], states.gradients[0][own], states.matrices[0][np.ix_(own, own)]


def evaluate_on(problem, track, side=1):
    """J, g and the Gauss-Newton matrix of the evaluator on the mesh of a beam, in the unknowns of the experiment."""
    evaluator = Evaluator(problem, meshes=[Mesh.from_times(track.times)])
    found = evaluator(problem.initial_theta, side=side, matrix="gauss-newton")
    own = np.append(np.arange(len(TIMES)), len(TIMES) + track.own[track.places])
    return found.cost, found.gradient[own], found.hessian[np.ix_(own, own)]


def gap(found, expected):
    return np.abs(np.asarray(found) - expected).max() / np.abs(expected).max()


@pytest.mark.parametrize("solver", ["auto", "stiff"])
@pytest.mark.parametrize("running", [False, True])
def test_costs_and_derivatives_are_those_of_the_evaluator(running, solver):
    """Those along p are of the same steps; those along a time differ by the error of the steps. With running costs, the
    Gauss-Newton matrix of rows that move with a transition has terms of the length of these rows.
    """
    problem, in_g, in_H = everything(running=running, solver=solver), [], []
    for grid in (0.05, 0.02, 0.01) if running else (0.2, 0.1, 0.05):
        track, J, g, H = follow_schedule(problem, grid)
        J_e, g_e, H_e = evaluate_on(problem, track)
        np.testing.assert_allclose(J, J_e, rtol=1e-12)
        assert max(gap(g[2:], g_e[2:]), gap(H[2:, 2:], H_e[2:, 2:])) < 1e-11
        in_g.append(gap(g, g_e))
        in_H.append(gap(H, H_e))
    if running:
        assert max(in_g) < 1e-8
        assert in_H[0] > 2.0 * in_H[1] > 3.0 * in_H[2]
    else:
        both = np.maximum(in_g, in_H)
        assert both[0] > 20 * both[1] > 400 * both[2]
        assert both[2] < 1e-9


def test_a_birth_at_a_sample_comes_after_it():
    """The derivatives are those for a later time; those for an earlier one differ, since the sample moves with it."""
    problem = everything(data=everything().experiments[0].data[0])
    track, _, g, H = follow_schedule(problem, 0.1)
    assert np.isin(TIMES, FIRST).all()
    _, g_later, H_later = evaluate_on(problem, track, side=1)
    _, g_earlier, H_earlier = evaluate_on(problem, track, side=-1)
    assert max(gap(g, g_later), gap(H, H_later)) < 1e-6
    assert gap(g, g_earlier) > 1e-2
    assert gap(H, H_earlier) > 1e-2


# A system that is linear in its unknowns: its linearised cost is its cost


def linear_problem(v=1.0, sequence=("rise",), times=(), **settings):
    modes = {"rise": lambda t, x, p: p["v"] - x, "fall": lambda t, x, p: -p["v"] - 0.5 * x}
    system = sf.HybridSystem(modes, [sf.Parameter(0.3)], **settings)
    data = sf.Measurements(np.linspace(0.1, 4.0, 40), np.random.default_rng(1).normal(size=(40, 1)), sigma=0.1)
    return sf.Problem(system, sf.Experiment(data, sequence, times, 0.0, 4.0), {"v": v}, max_transitions=2)


def test_without_switches_the_proposal_is_the_estimate():
    problem = linear_problem(sf.Parameter(1.0, prior=sf.Normal(mean=0.5, sd=0.05)))
    estimate = sf.estimate(problem, strategy="local")
    (found,) = beam(problem, make_library(["rise"], most=0), penalty=3.0, width=5)
    assert (found.sequences, len(found.transition_times[0])) == ((("rise",),), 0)
    np.testing.assert_allclose(found.parameters, estimate.theta, atol=1e-6)
    # the priors count, and besides them only the weak term of the initial state
    np.testing.assert_allclose(found.cost, estimate.cost, rtol=1e-4)


def test_two_names_of_one_parameter_are_one_unknown():
    """Both modes approach their level at the same rate; two rates would explain the noise better, by 0.3."""
    times, rng = np.linspace(0.1, 10.0, 60), np.random.default_rng(0)
    end = 1.0 - np.exp(-0.8 * 5.0)
    x = np.where(times < 5.0, 1.0 - np.exp(-0.8 * times), (1.0 + end) * np.exp(-0.8 * (times - 5.0)) - 1.0)
    modes = {"up": lambda t, x, p: -p["k1"] * (x - 1.0), "down": lambda t, x, p: -p["k2"] * (x + 1.0)}
    seen = sf.Measurements(times, (x + 0.02 * rng.normal(size=60))[:, None], sigma=0.02)
    run = sf.Experiment(seen, ("up", "down"), (4.0,), 0.0, 10.0, parameter_map={"k1": "k", "k2": "k"})
    problem = sf.Problem(sf.HybridSystem(modes, [0.0]), run, {"k": 1.3})
    fitted = sf.estimate(problem, strategy="local")
    proposal = beams.follow_order(problem, 0, np.array([1.3]))[0]
    np.testing.assert_allclose(proposal.parameters, fitted.parameters["k"], rtol=1e-4)
    np.testing.assert_allclose(proposal.cost, fitted.cost, rtol=1e-3)


def test_parameters_stay_inside_their_bounds():
    problem = linear_problem(sf.Parameter(1.0, lower=0.8, upper=1.1))
    found = beam(problem, make_library(("rise", "fall"), most=2), penalty=1.0, width=10)
    assert {proposal.parameters[0] for proposal in found} & {0.8, 1.1}
    assert all(0.8 <= proposal.parameters[0] <= 1.1 for proposal in found)


# Truths


BASE = three_modes(0).problem
SAMPLES = BASE.experiments[0].data[0].times


def draw_truth(seed):
    """A random sequence of six modes, its times, and its samples where a = 1."""
    truth = three_modes(seed)
    return truth.sequence, truth.times, truth.problem.experiments[0].data[0].values.copy()


def truth_problem(values, sigma=0.05):
    run = sf.Experiment(sf.Measurements(SAMPLES, values, sigma=sigma), ("A",), (), 0.0, 12.0)
    return sf.Problem(BASE.system, run, {**BASE.parameters, "a": sf.Parameter(0.8)})


def find(values, library=None, width=40, **given):
    return beam(truth_problem(values, **given), library or make_library("ABC"), penalty=3.0, width=width)


def test_random_truths():
    """One pass, from a parameter that is 20 % off: the true sequence is the best proposal, at its minimum."""
    right = 0
    for seed in range(20):
        sequence, times, values = draw_truth(seed)
        if seed == 4:
            values[::3, 0] = values[50:54] = np.nan
        best = find(values)[0]
        if best.sequences[0] == sequence:
            right += 1
            assert np.abs(best.transition_times[0] - times).max() < 0.3
            assert abs(best.parameters[0] - 1.0) < 0.02
    assert right >= 19


@pytest.mark.parametrize("seed", [0, 5])
def test_costs_are_those_of_the_evaluator(seed):
    """After the last pass, the costs of the best are their costs: J at the proposed schedule, and the penalties.

    Those where a mode has no duration too: in the linear model it could gain by a negative one.
    """
    _, _, values = draw_truth(seed)
    problem, collapsed = truth_problem(values), 0
    for proposal in find(values)[:12]:
        times = proposal.transition_times[0]
        kept = collapse(Schedule(proposal.sequences[0], times, 0.0, 12.0), make_library("ABC"), 1e-9)
        collapsed += len(kept.times) < len(times)
        run = replace(problem.experiments[0], mode_sequence=kept.sequence, transition_times=kept.times)
        exact = sf.evaluate(replace(problem, experiments=run), np.append(kept.times, proposal.parameters)).cost
        assert abs(proposal.cost - exact - 3.0 * len(times)) < 0.2
    assert collapsed


def test_rules_of_the_library():
    _, _, values = draw_truth(5)
    follow = {"A": ("B",), "B": ("C", "A"), "C": ("A",)}
    rules = {"first": ("B",), "last": ("A", "C"), "durations": {"A": 1.5, "B": 0.7}, "successions": follow}
    library = make_library("ABC", most=5, **rules)
    found = find(values, library)
    assert len(found) > 5
    for proposal in found:
        names, times = proposal.sequences[0], proposal.transition_times[0]
        assert library.admits(names)
        lengths = np.diff(np.concatenate([[0.0], times, [12.0]]))
        assert np.all(lengths >= np.array([library.durations[name] for name in names]) - 1e-9)
    assert len(find(values, make_library("ABC", most=0))) == 3


def test_few_hypotheses_have_different_sequences():
    """At most three that are kept have the same sequence: without that, a narrow beam would soon be of one."""
    assert len({p.sequences for p in find(draw_truth(7)[2], width=8)}) >= 3
    codes, switches = np.array([1, 1, 1, 1, 1, 2, 2, 3]), np.array([0, 0, 0, 0, 0, 1, 1, 2])
    values = np.array([0.1, 0.2, 0.3, 0.4, np.nan, 0.25, 0.05, 9.0])
    assert select_lowest(values, codes, switches, 6).tolist() == [6, 0, 1, 5, 2, 7]
    few = select_lowest(values, codes, switches, 4).tolist()
    assert few == [6, 0, 1, 5], "less than one is reserved for each"


def test_some_hypotheses_have_fewer_switches():
    """Where sigma is far too small every switch pays; the best with fewer are found all the same."""
    sequence, _, values = draw_truth(8)
    found = find(values, sigma=0.002)
    best = {}
    for proposal in found:
        best.setdefault(len(proposal.transition_times[0]), proposal.sequences[0])
    assert set(best) == set(range(9))
    assert best[5] == sequence
    values, codes, switches = np.arange(12.0), np.arange(12), np.repeat([2, 1, 0], 4)
    assert select_lowest(values, codes, switches, 6).tolist() == [0, 1, 2, 3, 4, 8]


def test_a_guarded_time_depends_on_the_parameters_as_the_implicit_derivative_says():
    """dtau = -(D_x c Z + D_p c) / (D_x c f + D_t c): x = 0.3 exp(-t) + v (1 - exp(-t)) meets c = x - v / 2."""
    guards = {("rise", "fall"): lambda t, x, p: x[0] - 0.5 * p["v"]}
    problem = linear_problem(sequence=("rise", "fall"), times=(0.5,), guards=guards)
    track = beams.prepare(problem, 0, make_library(("rise", "fall"), most=1), 0.1)
    tau, p = track.times[int(np.searchsorted(track.times, 0.3))], np.array([1.0, 0.3])
    node = int(np.searchsorted(track.times, tau))
    states = track.engine.begin(p, without_priors(3), (1e300, 1.0, 1e8), None)
    states = track.engine.advance(states, np.array([[0, 0, 0, -1, -1, -1, -1]]), 0, node)
    without = states.matrices[0], states.gradients[0]
    states = track.engine.advance(states, np.array([[0, 0, 1, 0, -1, -1, 0]]), node, node + 1)
    H, g = states.matrices[0] - without[0], states.gradients[0] - without[1]
    x, Z = 0.3 * np.exp(-tau) + 1 - np.exp(-tau), np.array([1 - np.exp(-tau), np.exp(-tau)])
    rate = 1.0 - x
    np.testing.assert_allclose(H[0, 1:] / H[0, 0], (Z - [0.5, 0.0]) / rate, rtol=1e-5)
    np.testing.assert_allclose(g[0] / H[0, 0], (x - 0.5) / rate, rtol=1e-4)


def test_births_are_on_an_even_grid_of_nodes():
    """Those nearest to it, also where samples are not evenly spaced, and with cells no longer than the grid."""
    times = np.array([0.1, 0.2, 0.31, 0.39, 0.5, 1.7, 4.0])
    log = sf.Measurements(times, np.array([1.0, np.nan, 2.0, 3.0, 4.0, 5.0, 6.0])[:, None], sigma=None)
    run = sf.Experiment(log, ("rise",), (), 0.0, 4.0, jumps=sf.Jump(2.15, lambda t, x, p: x))
    nodes = build_mesh(run, 0.3).times
    assert np.isin([0.0, *times, 2.15], nodes).all()
    births = nodes[choose_stops(nodes, 0.3)]
    np.testing.assert_allclose(births, [*(0.3 * np.arange(13)), 4.0], atol=0.15)
    counts = count_values([log], nodes)
    assert counts[np.searchsorted(nodes, [0.0, 0.1, 0.2, 0.31, 4.0])].tolist() == [0, 1, 1, 2, 6]
    assert choose_grid(run) == pytest.approx(0.11)
    assert choose_grid(replace(run, tf=12.0)) == pytest.approx(0.2)
