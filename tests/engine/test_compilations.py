"""What is compiled when: nothing as the unknowns move, nothing for another problem of the same size."""

import gc
import weakref

import numpy as np
import pytest

import switchfit as sf
from support.counted_traces import TRACES, oscillator
from support.models import charge
from support.models import decay as decay_at_k
from switchfit.discretization.mesh import pad_length
from switchfit.engine.jax.programs import call_model, derivatives, simulate_rows
from switchfit.engine.native.program_cache import _program_of, drop_programs
from switchfit.meshes.evaluator import evaluator_of


@pytest.fixture(scope="module")
def compiled():
    """Evaluated and fitted once: everything below has to get by with the programs of this."""
    problem = oscillator()
    for method in ("auto", "adjoint"):
        sf.evaluate(problem, method=method)
    sf.simulate(problem)
    assert sf.estimate(problem).success
    assert TRACES["count"] > 0
    return problem


def traces_of(call):
    before = TRACES["count"]
    call()
    return TRACES["count"] - before


@pytest.mark.parametrize("method", ["auto", "adjoint"])
def test_nothing_is_traced_as_tau_and_p_move(compiled, method):
    thetas = [[0.7, 2.0, 0.3], [2.9, 1.0, 0.0], [0.0, 2.0, -1.0], [3.3, 0.1, 0.3], [1.5, 2.0, 0.3]]
    costs = []
    assert traces_of(lambda: costs.extend(sf.evaluate(compiled, theta, method=method).cost for theta in thetas)) == 0
    assert len(set(costs)) == len(thetas)


@pytest.mark.parametrize(
    ("change", "call"),
    [
        ({"tau": 1.0, "seed": 1, "start": [0.9, 0.1]}, sf.evaluate),
        ({"samples": 11}, sf.evaluate),  # of the same padded length as the mesh of 9
        ({"tau": 1.2, "seed": 2}, sf.estimate),
    ],
)
def test_nothing_is_traced_for_another_problem_of_the_same_size(compiled, change, call):
    other = oscillator(**change)
    cells = [len(evaluator_of(problem).meshes[0].nodes) for problem in (other, compiled)]
    assert cells[0] == cells[1], "with its padding: experiments share programs where it is the same"
    assert evaluator_of(other) is evaluator_of(other), "its mesh is made once"
    assert traces_of(lambda: call(other)) == 0
    assert sf.evaluate(other).cost != sf.evaluate(compiled).cost


def count_programs():
    """How many programs of machine code, and of each kind that JAX compiles where there is none, were compiled."""
    of_jax = [program._cache_size() for program in (derivatives, simulate_rows, call_model)]
    return np.array([_program_of.cache_info().misses, *of_jax])


ROOM = sf.HybridSystem({"on": charge, "off": decay_at_k}, [0.3])


@pytest.mark.parametrize("change", [{}, {"samples": 40}, {"transitions": 3}], ids=["nothing", "samples", "transitions"])
def test_another_number_of_transitions_compiles_one_program_another_number_of_samples_none(change):
    def room(samples=9, transitions=1):
        times = np.linspace(0.2, 3.0, samples)
        knots = np.linspace(0.0, 3.0, transitions + 2)[1:-1] + 0.01
        data = sf.Measurements(times, np.sin(times), sigma=10.0)
        modes = [("on", "off")[k % 2] for k in range(transitions + 1)]
        return sf.Problem(ROOM, sf.Experiment(data, modes, knots, 0.0, 3.0), {"k": sf.Parameter(1.0, 0.5, 2.0)})

    drop_programs()  # of other tests, which may have fitted as many transitions of such a system
    sf.estimate(room(), strategy="local")
    size = pad_length(evaluator_of(room()).meshes[0].cells)
    if "samples" in change:
        assert pad_length(evaluator_of(room(**change)).meshes[0].cells) > size
    before = count_programs()
    fit = sf.estimate(room(**change), strategy="local")
    assert fit.integration_error < 1e-8, "the mesh has not been refined after the fit"
    assert (count_programs() - before).tolist() == ["transitions" in change, 0, 0, 0]


def test_a_problem_that_is_no_longer_used_is_freed(compiled):
    """Its meshes and arrays are kept with the problem, not in a table of the library's."""
    gc.freeze()  # the collector need not look at what was there before
    problem = oscillator(tau=1.05)
    sf.evaluate(problem)
    gone = weakref.ref(problem)
    del problem
    gc.collect()
    gc.unfreeze()
    assert gone() is None
