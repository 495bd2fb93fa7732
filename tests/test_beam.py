"""The prefix beam: its costs and derivatives against the evaluator, its rules, and what it finds."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import switchfit as sf
from switchfit.discretization.mesh import Mesh
from switchfit.engine.protocol import Column, Hypotheses
from switchfit.fit.evaluator import Evaluator
from switchfit.modes import beam as beams
from switchfit.modes.beam import beam


@dataclass(frozen=True)
class Library:
    """Modes that may follow each other freely, unless `successions` says otherwise."""

    modes: tuple[str, ...]
    first: tuple[str, ...]
    last: tuple[str, ...]
    max_switches: int = 8
    durations: dict = field(default_factory=dict)
    successions: dict | None = None

    def allows(self, before, after):
        return before != after if self.successions is None else after in self.successions[before]

    def min_duration(self, mode):
        return self.durations.get(mode, 0.0)


def free(modes, max_switches=8, **rules):
    modes = tuple(modes)
    return Library(modes, rules.pop("first", modes), rules.pop("last", modes), max_switches, **rules)


# A system with everything that a beam can follow


def swing(t, x, p, u):
    return jnp.stack([x[1], -p["k"] * jnp.sin(x[0]) - 0.3 * x[1] + u])


def drift(t, x, p, u):
    return jnp.stack([p["v"] - 0.2 * x[0] ** 2, jnp.cos(t) - p["k"] * x[1]])


def brake(t, x, p, u):
    return jnp.stack([x[1] * 0.5, -p["v"] * x[1] + 0.1 * x[0] + 0.2 * u])


def bounce(t, x, p):
    return jnp.stack([x[0] + 0.1 * jnp.sin(t), -0.7 * x[1] * p["k"]])


def dose(t, x, p):
    return x + jnp.stack([0.2 * p["v"], 0.0 * t])


SEQUENCE, TIMES, MODES = ("swing", "drift", "brake"), (1.2, 2.4), ("swing", "drift", "brake")
FIRST = np.array([0.0, 0.4, 0.8, 1.2, 1.6, 2.0, 2.4, 2.8, 3.2, 3.6, 4.0])
SECOND = np.array([0.3, 1.1, 1.9, 2.7, 3.5])


def everything(running=True, engine="auto", **more):
    """A problem with inputs, a reset map, an unknown initial state, sensors at different times, a robust loss, an
    unknown sigma, and costs at samples, along the way, at transitions and at the end.
    """
    rng = np.random.default_rng(3)
    values = rng.normal(size=(len(FIRST), 2))
    values[3, 0] = values[5] = np.nan
    slow = sf.Measurements(FIRST, values, sigma=[0.3, 0.5])
    fast = sf.Measurements(
        SECOND,
        rng.normal(size=(len(SECOND), 1)),
        observe=lambda t, x, p: x[:1] ** 2 + p["v"],
        sigma=0.2,
        loss="soft_l1",
    )
    noisy = sf.Measurements([0.6, 1.4, 3.0], rng.normal(size=(3, 1)), observe=lambda t, x, p: x[1:], sigma="s")
    follow = sf.ReferenceSignal.from_samples(np.linspace(0.0, 4.0, 9), rng.normal(size=(9, 2)), lowpass_hz=0.4)
    costs = [
        sf.RunningCost(lambda t, x, p: 0.1 * p["k"] * x[0] ** 2),
        sf.TransitionCost(lambda t, x, p: 0.3 * x[0] ** 2 * t + p["v"], before="swing"),
        sf.TerminalCost(lambda x, p: p["k"] * x[1] ** 2),
    ]
    along_the_way = [follow, costs.pop(0)]
    given = {"data": [slow, fast, noisy, *costs, *(along_the_way if running else [])]} | more
    system = sf.HybridSystem(
        {"swing": swing, "drift": drift, "brake": brake},
        [sf.Parameter(0.5), 0.2],
        reset_maps={("swing", "drift"): bounce, ("drift", "brake"): bounce},
    )
    run = sf.Experiment(
        mode_sequence=SEQUENCE,
        transition_times=TIMES,
        t0=0.0,
        tf=4.0,
        inputs=sf.Input([0.0, 1.0, 2.2, 4.0], [0.1, 0.5, -0.3, 0.0], kind="hold"),
        **given,
    )
    parameters = {"k": sf.Parameter(1.3, lower=0.2), "v": 0.6, "s": sf.Parameter(0.4, lower=0.01)}
    return sf.Problem(system, run, parameters, engine=engine)


def follow_schedule(problem, library, sequence, times, grid):
    """Propagate one hypothesis without priors and without moving its point of linearisation; return J, g, H."""
    track = beams._prepare(problem, 0, library, grid)
    S, D = track.births, track.births + len(track.places)
    nothing = Hypotheses(
        np.zeros(1), np.zeros(1), np.zeros((1, D)), np.zeros((1, D, D)), np.zeros((1, D)), np.zeros(0), np.zeros(0)
    )
    q = problem.initial_theta[len(problem.initial_theta) - len(problem.parameters) - 1 :]
    states = track.engine.begin(q[track.places], nothing, (1e300, 1.0), None)  # one step a cell
    nodes = [0, *np.searchsorted(track.times, times).tolist(), len(track.times) - 1]
    index = [track.modes.index(name) for name in sequence]
    for i, (first, last) in enumerate(zip(nodes[:-1], nodes[1:], strict=True)):
        before = index[max(i - 1, 0)]
        child = np.full((1, len(Column)), -1, dtype=np.int64)
        child[0, :4] = 0, before, index[i], i - 1
        child[0, Column.RESET_MAP] = track.resets[before, index[i]]
        child[0, Column.TRANSITION_COST] = track.costs[before, index[i]]
        states = track.engine.advance(states, child, first, last)
    N = len(times)
    own = np.concatenate([np.arange(N), np.arange(S, D)])
    return track, states.costs[0], states.gradients[0][own], states.matrices[0][np.ix_(own, own)]


def evaluate_on(problem, track, side=1):
    """J, g and the Gauss-Newton matrix of the evaluator on the mesh of a beam, in the unknowns of the experiment."""
    evaluator = Evaluator(problem, meshes=[Mesh.from_times(track.times)])
    found = evaluator(problem.initial_theta, side=side, matrix="gauss-newton")
    own = np.append(np.arange(len(TIMES)), len(TIMES) + track.places)
    return found.cost, found.gradient[own], found.hessian[np.ix_(own, own)]


def gap(found, expected):
    return np.abs(np.asarray(found) - expected).max() / np.abs(expected).max()


def both_on(problem, grid):
    """J, g and H of the beam and of the evaluator."""
    track, *found = follow_schedule(problem, free(MODES, 2), SEQUENCE, TIMES, grid)
    assert track.engine.engine.name == ("jax" if problem.engine == "jax" else "native")
    return found, evaluate_on(problem, track)


def test_costs_and_derivatives_are_those_of_the_evaluator():
    """Those along p are of the same steps; those along a time differ by the error of the steps."""
    problem, in_time = everything(running=False), []
    for grid in (0.2, 0.1, 0.05):
        (J, g, H), (J_e, g_e, H_e) = both_on(problem, grid)
        np.testing.assert_allclose(J, J_e, rtol=1e-12)
        assert max(gap(g[2:], g_e[2:]), gap(H[2:, 2:], H_e[2:, 2:])) < 1e-11
        in_time.append(max(gap(g, g_e), gap(H, H_e)))
    assert in_time[0] > 20 * in_time[1] > 400 * in_time[2]
    assert in_time[2] < 1e-9


def test_running_costs():
    """The Gauss-Newton matrix of rows that move with a transition has terms of the length of these rows."""
    problem, in_H = everything(), []
    for grid in (0.05, 0.02, 0.01):
        (J, g, H), (J_e, g_e, H_e) = both_on(problem, grid)
        np.testing.assert_allclose(J, J_e, rtol=1e-12)
        assert max(gap(g[2:], g_e[2:]), gap(H[2:, 2:], H_e[2:, 2:])) < 1e-11
        assert gap(g, g_e) < 1e-8
        in_H.append(gap(H, H_e))
    assert in_H[0] > 2.0 * in_H[1] > 3.0 * in_H[2]


def test_jax_propagates_as_machine_code_does():
    native, by_jax = (
        follow_schedule(everything(engine=engine), free(MODES, 2), SEQUENCE, TIMES, 0.2) for engine in ("native", "jax")
    )
    assert [track.engine.engine.name for track in (native[0], by_jax[0])] == ["native", "jax"]
    for one, other in zip(native[1:], by_jax[1:], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)


def test_a_birth_at_a_sample_comes_after_it():
    """The derivatives are those for a later time; those for an earlier one differ, since the sample moves with it."""
    problem = everything(data=everything().experiments[0].data[0])
    track, _, g, H = follow_schedule(problem, free(MODES, 2), SEQUENCE, TIMES, 0.1)
    assert np.isin(TIMES, FIRST).all()
    _, g_later, H_later = evaluate_on(problem, track, side=1)
    _, g_earlier, H_earlier = evaluate_on(problem, track, side=-1)
    assert max(gap(g, g_later), gap(H, H_later)) < 1e-6
    assert gap(g, g_earlier) > 1e-2 and gap(H, H_earlier) > 1e-2


def test_jumps_at_known_times():
    problem = everything(running=False, jumps=[sf.Jump([0.8, 3.1], dose), sf.Jump(0.8, bounce)])
    (J, g, H), (J_e, g_e, H_e) = both_on(problem, 0.1)
    without = both_on(everything(running=False), 0.1)[0][0]
    assert abs(J - without) > 0.1
    np.testing.assert_allclose(J, J_e, rtol=1e-12)
    assert max(gap(g, g_e), gap(H, H_e)) < 1e-6
