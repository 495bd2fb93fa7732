"""Several runs: what they share, what is their own, initial states that are estimated, and what all this costs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from switchfit.evaluate import evaluator_of

METHODS = ("auto", "forward", "discrete-adjoint", "autodiff")
TIMES = np.linspace(0.0, 2.0, 12)


def swing(t, x, p):
    """k is a vector, b a number; the Jacobian depends on time."""
    return jnp.array([x[1] * jnp.cos(t) + 0.2 * x[0] * x[1], -p["k"][0] * x[0] + 0.3 * p["k"][1] * x[1] ** 2])


def sway(t, x, p):
    return jnp.array([p["b"] * x[1] ** 2 - x[0] + 0.2 * jnp.cos(2 * t) * x[1], -x[0] * jnp.exp(-p["b"] * t)])


def kick(t, x, p):
    return jnp.array([1.1 * x[0] + p["b"] * t * x[1] ** 2, 0.2 * p["k"][0] ** 2 * jnp.sin(x[0]) - 0.7 * x[1]])


def seen(t, x, p):
    return jnp.array([x[0] + p["b"] * x[1] ** 2])


def last(x, p):
    return p["k"][1] * x[0] ** 2 * x[1]


SWING = sf.HybridSystem({"swing": swing, "sway": sway}, [0.7, 0.9], {("sway", "swing"): kick}, ("q", "v"), ("m", "m/s"))
GUESS = {"k": [0.8, 0.5], "b": 1.2, "k_2": [0.7, 0.6], "b_2": 1.1}


def run(sequence=("sway", "swing"), tau=(0.63,), seed=0, **given):
    values = np.random.default_rng(seed).normal(size=len(TIMES))
    data = [sf.Measurements(TIMES, values, observe=seen, sigma=0.5), sf.TerminalCost(last)]
    return sf.Experiment(data, sequence, tau, 0.0, 2.0, **given)


UNKNOWN = (sf.Parameter(0.75, lower=0.0, upper=3.0), sf.Parameter(0.85, lower=-2.0, upper=4.0, unit="mm/s"))


def mixed(**settings):
    """Nothing mapped and one state unknown; all mapped and both unknown; one name mapped and no state unknown."""
    runs = [
        run(initial_state=[UNKNOWN[0], 0.9], seed=1),
        run(initial_state=UNKNOWN, seed=2, parameter_map={"k": "k_2", "b": "b_2"}, name="second"),
        run(("swing", "sway", "swing"), (0.57, 1.31), seed=3, parameter_map={"b": "b_2"}),
    ]
    return sf.Problem(SWING, runs, GUESS, **settings)


def by_hand(**settings):
    """The same cost of the same theta, with functions made for each run, and initial states that are functions of p."""
    names = ("k", "b", "k_2", "b_2", "starts")

    def with_names(function, **names):
        return lambda *given: function(*given[:-1], {key: given[-1][name] for key, name in names.items()})

    systems = [
        sf.HybridSystem(
            {"swing": with_names(swing, k=k, b=b), "sway": with_names(sway, k=k, b=b)},
            start,
            {("sway", "swing"): with_names(kick, k=k, b=b)},
        )
        for k, b, start in (
            ("k", "b", lambda p: jnp.array([p["starts"][0], 0.9])),
            ("k_2", "b_2", lambda p: p["starts"][1:]),
            ("k", "b_2", [0.7, 0.9]),
        )
    ]
    given = mixed().experiments
    parts = []
    for system, experiment, k, b in zip(systems, given, ("k", "k_2", "k"), ("b", "b_2", "b_2"), strict=True):
        samples, _ = experiment.data
        data = [
            sf.Measurements(samples.times, samples.values, observe=with_names(seen, k=k, b=b), sigma=samples.sigma),
            sf.TerminalCost(with_names(last, k=k, b=b)),
        ]
        own = sf.Experiment(data, experiment.mode_sequence, tuple(experiment.initial_times), 0.0, 2.0)
        parts.append(sf.Problem(system, own, GUESS | {"starts": [0.75, 0.75, 0.85]}, **settings))
    assert [*parts[0].parameters] == list(names)
    return parts


def summed(parts):
    """Cost, gradient and Hessian of `by_hand` in the order of theta of `mixed`."""
    J, g, H = 0.0, np.zeros(13), np.zeros((13, 13))
    first = 0
    for part in parts:
        found = sf.evaluate(part)
        N = len(part.theta_names) - 9
        place = [*range(first, first + N), *range(4, 13)]
        first += N
        J += found.cost
        g[place] += found.gradient
        H[np.ix_(place, place)] += found.hessian
    return J, g, H


# --- names ------------------------------------------------------------------------------------------------------------


def test_theta_in_its_order():
    problem = mixed()
    assert problem.theta_names == (
        "run1.tau_1", "second.tau_1", "run3.tau_1", "run3.tau_2",
        "k[0]", "k[1]", "b", "k_2[0]", "k_2[1]", "b_2",
        "run1.q(t0)", "second.q(t0)", "second.v(t0)",
    )  # fmt: skip
    assert problem.unknowns.units == ("s",) * 4 + ("",) * 6 + ("m", "m", "mm/s")
    np.testing.assert_array_equal(
        problem.initial_theta, [0.63, 0.63, 0.57, 1.31, 0.8, 0.5, 1.2, 0.7, 0.6, 1.1, 0.75, 0.75, 0.85]
    )
    np.testing.assert_array_equal(problem.unknowns.lower[10:], [0.0, 0.0, -2.0])
    np.testing.assert_array_equal(problem.unknowns.upper[10:], [3.0, 3.0, 4.0])


def test_one_experiment_needs_no_prefix_and_states_need_no_names():
    system = sf.HybridSystem({"m": lambda t, x, p: -x}, [1.0, sf.Parameter(2.0), sf.Parameter(3.0, fixed=True)])
    one = sf.Experiment(sf.TerminalCost(lambda x, p: x @ x), ("m",), (), 0.0, 1.0)
    assert sf.Problem(system, one).theta_names == ("x2(t0)",)
    both = sf.Problem(system, [one, one])
    assert both.theta_names == ("run1.x2(t0)", "run2.x2(t0)")  # those of the system too are each run's own
    np.testing.assert_allclose(sf.simulate(both, [5.0, 7.0], experiment=1).states[0], [1.0, 7.0, 3.0])


def test_a_parameter_of_n_numbers_is_an_initial_state():
    start = sf.Parameter([1.0, 2.0], lower=[0.0, 1.0], upper=9.0, unit="m")
    problem = sf.Problem(SWING, run(initial_state=start), GUESS)
    assert problem.theta_names[-2:] == ("q(t0)", "v(t0)")
    np.testing.assert_array_equal(problem.unknowns.lower[-2:], [0.0, 1.0])
    assert problem.unknowns.units[-2:] == ("m", "m")


# --- derivatives ------------------------------------------------------------------------------------------------------


def test_runs_add_up_to_runs_written_by_hand():
    J, g, H = summed(by_hand())
    found = sf.evaluate(mixed())
    assert found.cost == pytest.approx(J, rel=1e-12)
    np.testing.assert_allclose(found.gradient, g, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(found.hessian, H, rtol=1e-8, atol=1e-9)
    assert np.count_nonzero(H[9]) > 3  # the initial state tells on the transition time and the parameters of its run


def test_all_methods_agree():
    """With an initial state of which one entry is known, and parameters under other names."""
    start = [0.9, UNKNOWN[0]]
    problem = sf.Problem(SWING, run(initial_state=start, parameter_map={"k": "k_2", "b": "b_2"}), GUESS)
    found = {method: sf.evaluate(problem, method=method) for method in METHODS}
    base = found["auto"]
    for other in found.values():
        assert other.cost == pytest.approx(base.cost, rel=1e-12)
        np.testing.assert_allclose(other.gradient, base.gradient, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(other.hessian, base.hessian, rtol=1e-8, atol=1e-9)
    check = sf.check_derivatives(problem)  # by the paper's equations too, and by Taylor's
    assert check.passed, str(check)
    assert np.isfinite(check.observed_orders).all()
    assert check.hessian_gap_halved < check.hessian_gap / 16
    assert np.count_nonzero(base.gradient) == 5  # of tau, k_2, b_2 and v(t0); k and b belong to others


def test_taylor_orders_with_the_stiff_solver():
    start = [sf.Parameter(0.7), sf.Parameter(0.4)]
    system = sf.HybridSystem({"m": lambda t, x, p: jnp.array([-p["k"] * x[0] * x[1], jnp.sin(x[0]) - x[1]])}, start)
    data = sf.Measurements([0.5, 1.0], [[0.5, 0.2], [0.3, 0.4]])
    runs = [sf.Experiment(data, ("m",), (), 0.0, 1.0, parameter_map={"k": name}) for name in ("k_1", "k_2")]
    problem = sf.Problem(system, runs, {"k_1": 1.0, "k_2": 2.0}, solver="stiff")
    check = sf.check_derivatives(problem)
    assert check.passed, str(check)
    assert np.isfinite(check.observed_orders).all()


def test_gauss_newton_is_that_of_runs_written_by_hand():
    problem, parts = mixed(), by_hand()
    whole = evaluator_of(problem)(problem.initial_theta, matrix="gauss-newton").hessian
    own = evaluator_of(parts[1])(parts[1].initial_theta, matrix="gauss-newton").hessian
    np.testing.assert_allclose(whole[11:, 11:], own[-2:, -2:], rtol=1e-9)


def test_two_names_may_mean_one_parameter():
    """Derivatives in it are those in both names together."""
    system = sf.HybridSystem({"m": lambda t, x, p: -p["slow"] * p["fast"] ** 2 * x}, [1.0])
    cost = sf.TerminalCost(lambda x, p: x[0] * p["fast"])
    once = sf.Experiment(cost, ("m",), (), 0.0, 1.0, parameter_map={"slow": "rate", "fast": "rate"})
    found = sf.evaluate(sf.Problem(system, once, {"rate": 0.7}, rtol=1e-11))
    with jax.enable_x64(True):
        J, slope, bend = (float(f(0.7)) for f in derivatives_of(lambda q: q * jnp.exp(-(q**3))))
    assert found.cost == pytest.approx(J, rel=1e-10)
    np.testing.assert_allclose(found.gradient, [slope], rtol=1e-7)
    np.testing.assert_allclose(found.hessian, [[bend]], rtol=1e-7)


def derivatives_of(function):
    first = jax.grad(function)
    return function, first, jax.grad(first)


# --- which parameters a run has ---------------------------------------------------------------------------------------


def names_of(problem, e=0):
    return [name for name, _, _ in problem.structures[e].parameters]


def test_a_run_is_differentiated_in_what_its_functions_ask_for():
    problem = mixed()
    assert [names_of(problem, e) for e in range(3)] == [["k", "b"]] * 3
    assert [structure.M for structure in problem.structures] == [4, 5, 3]
    unused = sf.Problem(SWING, run(), GUESS | {"idle": 1.0})
    assert names_of(unused) == ["k", "b"]
    assert sf.evaluate(unused).gradient[-1] == 0.0


def test_a_target_is_there_under_its_own_name_too_if_asked_for():
    system = sf.HybridSystem({"m": lambda t, x, p: -p["k"] * x}, [1.0])
    cost = sf.TerminalCost(lambda x, p: x[0])
    plain = sf.Experiment(cost, ("m",), (), 0.0, 1.0)
    doubled = sf.HybridSystem({"m": lambda t, x, p: -p["k"] * x, "n": lambda t, x, p: -p["k1"] * p["k2"] * x}, [1.0])
    mapped = sf.Experiment(cost, ("n",), (), 0.0, 1.0, parameter_map={"k1": "k", "k2": "k"})
    both = sf.Problem(doubled, [plain, mapped], {"k": 0.5})
    assert names_of(both, 0) == ["k"]
    expected = np.exp(-0.5) + np.exp(-0.25)
    assert sf.evaluate(both).cost == pytest.approx(expected, rel=1e-8)
    np.testing.assert_allclose(sf.evaluate(both).gradient, [-np.exp(-0.5) - np.exp(-0.25)], rtol=1e-7)
    assert sf.Problem(system, plain, {"k": 0.5}).theta_names == ("k",)


@pytest.mark.parametrize(
    "whole", [lambda p: sum(p.values()), lambda p: jax.jit(lambda q: q["a"] + q["b"])(p), lambda p: {**p}["a"] + p["b"]]
)
def test_a_function_that_takes_p_as_a_whole_sees_what_is_its_own(whole):
    """Not the parameters of other runs, which their maps name."""
    system = sf.HybridSystem({"m": lambda t, x, p: -whole(p) * x}, [1.0])
    runs = [
        sf.Experiment(sf.TerminalCost(lambda x, p: x[0]), ("m",), (), 0.0, 1.0, parameter_map={"b": name})
        for name in ("b_1", "b_2")
    ]
    problem = sf.Problem(system, runs, {"a": 0.3, "b_1": 0.1, "b_2": sf.Parameter(0.2, fixed=True)})
    assert sf.evaluate(problem).cost == pytest.approx(np.exp(-0.4) + np.exp(-0.5), rel=1e-8)
    assert [names_of(problem, e) for e in range(2)] == [["a", "b"]] * 2


def test_a_run_of_a_map_may_have_a_vector_and_a_fixed_parameter():
    system = sf.HybridSystem({"m": lambda t, x, p: -jnp.sum(p["rates"]) * x}, [1.0])
    runs = [
        sf.Experiment(sf.TerminalCost(lambda x, p: x[0]), ("m",), (), 0.0, 1.0, parameter_map={"rates": name})
        for name in ("one", "three")
    ]
    problem = sf.Problem(system, runs, {"three": [0.1, 0.2, 0.3], "one": sf.Parameter(0.4, fixed=True)})
    found = sf.evaluate(problem)
    assert found.cost == pytest.approx(np.exp(-0.4) + np.exp(-0.6), rel=1e-8)
    np.testing.assert_allclose(found.gradient, -np.exp(-0.6) * np.ones(3), rtol=1e-7)
