"""Both engines answer alike, whatever is asked; which one runs, and why; one program for many sequences."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.swings import BOUNCE, DATA, GUARDS, MODES, MORE, PARAMETERS, RICH, problem, samples
from switchfit.engine.native import program_cache
from switchfit.meshes.evaluator import Evaluator, evaluator_of

HARD = sf.HybridSystem(MODES | {"hard": lambda t, x, p: jnp.fft.fft(x).real * -p["k"]}, [0.4, 0.1])


def both(given):
    """The evaluators of machine code and of JAX, on the same mesh."""
    native = Evaluator(replace(given, engine="native"))
    return native, Evaluator(replace(given, engine="jax"), meshes=native.meshes)


def assert_same(found, expected):
    """J, its derivatives, and those of constraints where there are some."""
    np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-12)
    np.testing.assert_allclose(found.gradient, expected.gradient, rtol=1e-10, atol=1e-11)
    np.testing.assert_allclose(found.hessian, expected.hessian, rtol=1e-9, atol=1e-9)
    if found.jacobian.size:
        np.testing.assert_allclose(found.jacobian, expected.jacobian, rtol=1e-10, atol=1e-11)


WITH_ALL = [(RICH[0], "exact"), (RICH[1], "gauss-newton")]
"""What is compared by default: of the matrices, only that of Gauss and Newton shows the weights of a reference."""

CHOICES = [(name, matrix) for name in RICH for matrix in ("exact", "gauss-newton", "none")]


@pytest.mark.parametrize(
    ("name", "matrix"), [pytest.param(*each, marks=[pytest.mark.slow] * (each not in WITH_ALL)) for each in CHOICES]
)
def test_derivatives_are_the_same(name, matrix):
    given = problem(DATA[name], parameters=MORE)
    native, by_jax = both(given)
    for theta in (given.initial_theta, given.check_theta([1.2, 1.2, 1.3, 0.7, 0.8, 0.2])):
        assert_same(native(theta, matrix=matrix), by_jax(theta, matrix=matrix))


def test_what_the_papers_equations_do_not_know_is_not_compared_with_them():
    given = problem(DATA["transitions, end"])
    with pytest.raises(ValueError, match="the paper's equations have no TransitionCost: choose another method"):
        sf.evaluate(given, method="adjoint")
    check = sf.check_derivatives(given)
    assert check.passed
    assert "not checked" in str(sf.estimate(given, strategy="local").certificate)


def programs():
    return program_cache._program_of.cache_info().misses


SEQUENCES = {
    ("swing",): (),
    ("fall", "swing"): (1.3,),
    ("swing", "fall", "swing"): (0.6, 2.2),
    ("rest", "fall", "swing", "rest", "fall"): (0.5, 1.0, 1.7, 2.0),
    ("swing", "swing", "rest"): (1.0, 1.4),
}


def slopes_of(evaluator, simulation):
    """Derivatives of the states behind the rows in all of theta, (Q, n, d): 0 for unknowns that have no part."""
    own = simulation.tangents.after
    slopes = np.zeros((*own.shape[:2], len(evaluator.problem.initial_theta)))
    slopes[..., evaluator.problem.places[0]] = own
    return slopes


def evaluate(evaluator):
    """At the guess, with constraints and the Hessian of their Lagrangian where there are some."""
    theta = evaluator.problem.initial_theta
    return evaluator.constrained(theta, 1, 0.7) if evaluator.problem.constraint_names else evaluator(theta)


@pytest.mark.parametrize("data", [RICH[0], pytest.param(RICH[1], marks=pytest.mark.slow)])
def test_sequences_of_any_length_run_in_a_program_with_room_for_them(data):
    """Sequences with fewer transitions leave segments idle: all is as in a program of their own length.

    JAX takes part in the shortest case with a transition, in slow runs: it compiles its programs for every length.
    """
    system = sf.HybridSystem(MODES, [0.4, 0.1], BOUNCE, guards=GUARDS)
    compiled = []
    for sequence, times in SEQUENCES.items():
        own = Evaluator(problem(DATA[data], sequence, times, system, MORE, engine="native"))
        room = replace(own.problem, max_transitions=4)
        others = [own]
        if data == RICH[1] and sequence == ("fall", "swing"):
            others.append(Evaluator(replace(room, engine="jax"), meshes=own.meshes))
        before = programs()
        native = Evaluator(room, meshes=own.meshes)
        theta = room.initial_theta
        found, cost = evaluate(native), native.cost(theta)
        simulation = native.engines[0].simulate(*native.problem.vectors(theta, 0), tangents=True)
        compiled.append(programs() - before)
        for other in others:
            assert_same(found, evaluate(other))
            assert cost == pytest.approx(found.cost, rel=1e-12)
            its = other.engines[0].simulate(*other.problem.vectors(theta, 0), tangents=True)
            np.testing.assert_allclose(simulation.after, its.after, rtol=1e-11, atol=1e-12)
            slopes = slopes_of(native, simulation), slopes_of(other, its)
            np.testing.assert_allclose(*slopes, rtol=1e-10, atol=1e-11)
    assert not any(compiled[1:]), "a sequence needs a program of its own"


def test_two_costs_at_one_transition_are_refused():
    costs = [sf.TransitionCost(lambda t, x, p: x[0]), sf.TransitionCost(lambda t, x, p: t, before="swing")]
    with pytest.raises(ValueError, match="2 TransitionCosts count at a transition from 'swing' to"):
        problem([samples(), *costs])


def test_the_problem_says_which_engine_it_wants():
    given = problem(samples())
    assert evaluator_of(given).engine == evaluator_of(replace(given, engine="native")).engine
    assert str(evaluator_of(replace(given, engine="jax")).engine) == "Evaluated by JAX: engine='jax' is set."
    with pytest.raises(ValueError, match=r"engine must be one of auto, native, jax|engine"):
        problem(samples(), engine="gpu")


def test_machine_code_that_is_insisted_on_is_refused_with_the_reason():
    given = problem(samples(), ("hard",), (), HARD, engine="native")
    with pytest.raises(ValueError, match=r"engine='native' requires machine code, but mode 'hard' calls jnp\.fft"):
        sf.estimate(given)


@pytest.mark.parametrize(
    ("mode", "parameters", "reason"),
    [
        ("hard", PARAMETERS, "mode 'hard' calls jnp.fft"),
        ("fall", {"g": sf.Parameter(0.8, fixed=True)}, "an experiment has no unknowns"),
    ],
)
def test_an_experiment_without_machine_code_does_not_send_the_others_to_jax(mode, parameters, reason):
    runs = [
        sf.Experiment(samples(), (mode,), (), 0.0, 3.0),
        sf.Experiment(samples(), ("swing",), (), 0.0, 3.0, parameter_map={"k": "other"}),
    ]
    given = sf.Problem(HARD, runs, parameters | {"other": 1.2})
    evaluator = evaluator_of(given)
    assert [each.engine.name for each in evaluator.engines] == ["jax", "native"]
    assert evaluator.engine.reason.startswith(reason)
    assert evaluator.engine.reason.endswith("(in run1)")
    expected = evaluator(given.initial_theta, method="discrete-adjoint")
    np.testing.assert_allclose(evaluator(given.initial_theta).hessian, expected.hessian, rtol=1e-10, atol=1e-11)
