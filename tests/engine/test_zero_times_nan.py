"""Zero times what is not finite is not a number, in machine code as in JAX."""

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from switchfit.meshes.evaluator import evaluator_of

TIMES = np.linspace(0.1, 1.0, 5)
GOOD, BAD = 0.5, -0.5


def problem_of(mode, observe=None, initial=None, data=(), states=2, **transitions):
    """Two parameters, a and b; b = 0.5 at the guess."""
    system = sf.HybridSystem({"one": mode, "two": mode}, initial or [1.0] * states, **transitions)
    seen = observe or (lambda t, x, p: x[:1])
    log = sf.Measurements(TIMES, np.exp(-TIMES), observe=seen, sigma=0.1)
    run = sf.Experiment([log, *data], ("one", "two"), (0.45,), 0.0, 1.0)
    return sf.Problem(system, run, {"a": 0.8, "b": GOOD})


def plain(t, x, p):
    return -p["a"] * x * (1.0 + 0.0 * p["b"])


def away(t, x, p):
    """The second state is far from the first, which alone is measured."""
    return jnp.stack([-p["a"] * x[0], p["b"] * x[1] ** 2])


def compared(t, x, p):
    """An exponential of which f shows only on which side of 2 it is."""
    e = jnp.exp(-2000.0 * p["b"])
    return -p["a"] * x * jnp.where(e < 2.0, 1.0, 0.5) + 0.0 * e


CASES = {
    "in a reset": lambda: problem_of(
        plain, reset_maps={("one", "two"): lambda t, x, p: x + 0.0 * jnp.arccosh(1.0 + p["b"])}
    ),
    "exponential that the backward step takes from the forward one": lambda: problem_of(compared),
    "derivative of a root": lambda: problem_of(
        lambda t, x, p: jnp.stack([-p["a"] * x[0], jnp.sqrt(jnp.maximum(p["b"], 0.0))])
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_both_engines_agree_on_what_is_not_a_number(name):
    problem = CASES[name]()
    evaluator = evaluator_of(problem)
    for b, wrong in ((GOOD, False), (BAD, True)):
        theta = problem.initial_theta
        theta[-1] = b
        fast, slow = (evaluator(theta, method=method) for method in ("auto", "discrete-adjoint"))
        assert evaluator.engine.name == "native", evaluator.engine
        assert (not np.isfinite([fast.cost, *fast.gradient, *fast.hessian.ravel()]).all()) == wrong
        for kind in ("cost", "gradient", "hessian"):
            one, other = np.atleast_1d(getattr(fast, kind)), np.atleast_1d(getattr(slow, kind))
            np.testing.assert_array_equal(np.isfinite(one), np.isfinite(other), err_msg=kind)
            np.testing.assert_allclose(one[np.isfinite(one)], other[np.isfinite(other)], rtol=1e-9, atol=1e-9)
        assert np.isnan(evaluator.cost(theta)) == np.isnan(slow.cost)


def test_a_state_that_overflows_beside_the_others_is_seen():
    """x[1] = 1 / (1 - b t) leaves all numbers behind; only x[0] is measured, with a gain of zero for x[1]."""
    problem = problem_of(away, observe=lambda t, x, p: x[:1] + jnp.array([[0.0]]) @ x[1:])
    evaluator = evaluator_of(problem)
    theta = problem.initial_theta
    assert np.isfinite(evaluator(theta).cost)
    theta[-1] = 2000.0
    assert np.isnan(evaluator(theta, method="discrete-adjoint").cost)
    assert np.isnan(evaluator(theta).cost)


def test_simulations_see_it_too():
    problem = problem_of(plain, observe=lambda t, x, p: x[:1] + 0.0 * jnp.log(p["b"]))
    theta = problem.initial_theta
    theta[-1] = BAD
    sf.simulate(problem, theta)  # the states are finite
    with pytest.raises(ValueError, match=r"initial_state .* not finite"):
        sf.simulate(problem_of(plain, initial=lambda p: jnp.ones(2) + 0.0 * jnp.log(p["b"])), theta)
    with pytest.raises(ValueError, match="mode 'one' returned"):
        sf.simulate(problem_of(lambda t, x, p: -p["a"] * x + 0.0 * jnp.log(p["b"])), theta)
