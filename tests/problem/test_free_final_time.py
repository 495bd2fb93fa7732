"""A free final time: closed forms, all methods and both engines, what is printed, drawn and saved, what is refused."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support import swings as protocol
from support.models import decay, fit_problem, refused

COOLS = sf.HybridSystem({"cools": decay}, [1.0])


def test_derivatives_pass_every_check():
    """Two transitions, one with a reset map and one with a guard, a reference signal, late samples and costs of every
    kind, all of them nonlinear and dependent on time."""
    costs = [
        sf.Measurements(protocol.TIMES[2:8], protocol.VALUES[2:8], sigma="s", delay="d"),
        *protocol.DATA["transitions, end"][1:],
        *protocol.DATA["reference, running"][:2],
        sf.TerminalConstraint(lambda x, p: jnp.stack([x[0] * x[1] - p["k"], x[1] ** 2])),
    ]
    system = sf.HybridSystem(protocol.MODES, [0.4, 0.1], protocol.BOUNCE, guards=protocol.GUARDS)
    tf = sf.Parameter(2.4, lower=1.6, upper=3.0)
    run = sf.Experiment(costs, ("swing", "fall", "swing"), (0.83, 1.57), 0.0, tf)
    found = sf.check_derivatives(sf.Problem(system, run, protocol.PARAMETERS | protocol.MORE))
    assert found.passed, str(found)


# --- fits -------------------------------------------------------------------------------------------------------------

RATE, LEVEL = 0.4, 0.2
TIMES = np.linspace(0.1, 2.0, 20)


def cooling_run(seed=0, start=1.0, name=None, tf=None, more=()):
    """A log of x' = -k x up to 2 s; when does x reach the level?"""
    values = start * np.exp(-RATE * TIMES) + 0.01 * np.random.default_rng(seed).normal(size=20)
    data = [sf.Measurements(TIMES, values, sigma=0.01), sf.TerminalConstraint(lambda x, p: x[0] - LEVEL), *more]
    tf = sf.Parameter(5.0, lower=2.0, upper=9.0) if tf is None else tf
    return sf.Experiment(data, ("cools",), (), 0.0, tf, initial_state=[start], name=name)


def cooling(*runs, **more):
    return sf.Problem(COOLS, list(runs) or cooling_run(), {"k": sf.Parameter(0.6, lower=0.05, upper=3.0)} | more)


@pytest.fixture(scope="module")
def cooled():
    return sf.estimate(cooling())


def test_the_time_to_a_level_and_its_standard_error_follow_from_the_rate(cooled):
    """tf = ln(1 / level) / k, which the samples up to 2 s determine through k."""
    assert cooling(cooling_run(tf=sf.Parameter(3.0, fixed=True))).theta_names == ("k",)
    assert cooled.theta_names == ("tf", "k")
    tf, k = cooled.theta
    assert tf == pytest.approx(np.log(1 / LEVEL) / k, rel=1e-8)
    assert cooled.final_times == (tf,)
    decayed = np.exp(-k * TIMES)
    residual, slope = cooled.problem.experiments[0].data[0].values[:, 0] - decayed, -TIMES * decayed
    assert residual @ slope == pytest.approx(0.0, abs=1e-6)
    error = 0.01 * (slope @ slope - residual @ (TIMES**2 * decayed)) ** -0.5
    assert cooled.standard_errors[1] == pytest.approx(error, rel=1e-5)
    assert cooled.standard_errors[0] == pytest.approx(tf / k * cooled.standard_errors[1], rel=1e-7)
    path = sf.simulate(cooled.problem, [9.0, 0.5])  # tf at its upper bound
    assert (path.times[-1], path.states[-1, 0]) == (9.0, pytest.approx(np.exp(-4.5), rel=1e-8))


@pytest.mark.slow
def test_what_is_printed_drawn_predicted_and_saved_ends_at_tf(cooled, tmp_path):
    fit = cooled
    tf = fit.final_times[0]
    assert fit.trajectory.mode_spans == [("cools", 0.0, tf)]
    assert "  tf   3.986  ± 0.033" in str(fit)
    assert {ax.get_xlim() for ax in fit.plot(bands=True).axes} == {(0.0, tf)}
    assert fit.predict().times[-1] == tf
    # At a fixed time: x(t) = exp(-k t), whatever tf is.
    at_end = fit.predict([1.0, tf])
    expected = at_end.times * at_end.outputs[:, 0] * fit.standard_errors[1]
    np.testing.assert_allclose(at_end.output_errors[:, 0], expected, rtol=1e-6)
    fit.save(tmp_path / "fit.json")
    loaded = sf.Estimate.load(tmp_path / "fit.json")
    assert str(loaded) == str(fit)
    assert (loaded.final_times, loaded.final_places) == ((tf,), (0,))


@pytest.mark.slow
def test_each_of_several_runs_has_its_own_tf_beside_runs_without():
    known = cooling_run(2, start=0.7, tf=2.5)
    known = replace(known, data=known.data[:1])
    problem = cooling(cooling_run(0, name="hot"), known, cooling_run(1, start=0.6, name="warm"))
    assert problem.theta_names == ("hot.tf", "warm.tf", "k")
    assert sf.check_derivatives(problem).passed
    fit = sf.estimate(problem)
    k = fit.parameters["k"]
    np.testing.assert_allclose(fit.final_times, [np.log(1 / LEVEL) / k, 2.5, np.log(0.6 / LEVEL) / k], rtol=1e-8)
    assert [path.times[-1] for path in fit.trajectories] == list(fit.final_times)
    assert fit.final_places == (0, -1, 1)


def test_multistart_draws_tf_between_its_bounds_and_monte_carlo_varies_it():
    starts = sf.multistart(cooling(), starts=16, seed=2)
    drawn = starts.start[1:, 0]
    assert 2.0 <= drawn.min() < drawn.max() - 4.0 <= 5.0
    assert starts.success.all()  # some with constraints that are nearly met all the way, and never better than at first
    np.testing.assert_allclose(starts.theta, np.broadcast_to(starts.theta[0], starts.theta.shape), rtol=1e-6)
    fits = sf.monte_carlo(cooling(), runs=12, seed=3, theta=[np.log(1 / LEVEL) / RATE, RATE])
    assert fits.success.all()
    np.testing.assert_allclose(fits.theta[:, 0], np.log(1 / LEVEL) / fits.theta[:, 1], rtol=1e-7)
    assert np.ptp(fits.theta[:, 0]) > 0.02


@pytest.mark.parametrize("start", [(8.36892163, 2.13785481), (7.27120961, 2.65140112)])
def test_a_constraint_that_hardly_depends_on_the_unknowns_at_the_start_is_met(start):
    """x(tf) is nearly 0 at the start whatever tf and k: its gradient there is no measure of the constraint. Nor has a
    violation stagnated for good that stays the same while a trust region that was small grows again."""
    fit = fit_problem(cooling(), start=start, strategy="local", success=True)
    assert fit.iterations < 60
    np.testing.assert_allclose(fit.theta[0], np.log(1 / LEVEL) / fit.theta[1], rtol=1e-7)


@pytest.mark.slow
def test_batches_without_constraints_take_a_free_tf_in_their_compiled_program():
    """A prior on tf and a cost of x(tf): the program that all fits share, and one fit alone, end in the same place."""
    samples = sf.Measurements(TIMES, np.exp(-RATE * TIMES), sigma=0.01)
    data, prior = [samples, sf.TerminalCost(lambda x, p: 9 * (x[0] - 0.3) ** 2)], sf.Normal(3.5, 0.5)
    problem, *others = (
        cooling(sf.Experiment(data, ("cools",), (), 0.0, sf.Parameter(value, lower=2.0, upper=9.0, prior=prior)))
        for value in (4.0, 2.5, 6.0)
    )
    tf, k = sf.estimate(problem).theta
    slope = -18 * k * np.exp(-k * tf) * (np.exp(-k * tf) - 0.3) + (tf - 3.5) / 0.25
    assert slope == pytest.approx(0.0, abs=1e-6)
    assert sf.monte_carlo(problem, runs=6, seed=5, theta=np.array([3.2, RATE])).success.all()
    np.testing.assert_allclose(sf.estimate_many(others).theta, [[tf, k]] * 2, rtol=1e-6)


def minimum_time(upper=5.0):
    """From rest to rest over 1 m with at most 1 m/s^2: one switch half way, 2 s."""
    push, brake = (lambda t, x, p, u=u: jnp.stack([x[1], u * jnp.ones(())]) for u in (1.0, -1.0))
    ends = [sf.TerminalConstraint(lambda x, p: x[0] - 1.0), sf.TerminalConstraint(lambda x, p: x[1:2])]
    run = sf.Experiment([LASTING, *ends], ("push", "brake"), (0.7,), 0.0, sf.Parameter(2.5, upper=upper))
    return sf.Problem(sf.HybridSystem({"push": push, "brake": brake}, [0.0, 0.0]), run)


@pytest.mark.parametrize(
    ("upper", "start"),
    [
        (2.6, [0.7, 2.5]), (50.0, [0.7, 2.5]), (5.0, [0.01, 0.02]), (5.0, [0.02, 4.9]), (5.0, [4.9, 4.99]),
        # Through a node of the mesh at which derivatives jump by the error of integration alone
        (5.0, [0.363, 0.379]),
    ],
)  # fmt: skip
def test_minimum_time_is_found_from_anywhere_whatever_the_upper_bound(upper, start):
    fit = fit_problem(minimum_time(upper), start=start, strategy="local", success=True)
    assert fit.evaluations < 40
    np.testing.assert_allclose(fit.theta, [1.0, 2.0], rtol=0, atol=1e-9)
    # T = 2 sqrt(q): 1 m more takes dT/dq = 1 s/m longer, which is what the multiplier says.
    assert fit.constraints[0][2] == pytest.approx(-1.0, abs=1e-7)


PENDULUM_ARCS = (1.0, np.pi, np.pi, 2.0)


LASTING = sf.RunningCost(lambda t, x, p: jnp.ones(()))
"""Its integral is the time that a run takes."""


def pendulum():
    """x'' + x = u with |u| <= 1, from four arcs away to rest at 0 in the least time."""
    start = np.zeros(2)
    for u, arc in zip((1, -1, 1, -1), PENDULUM_ARCS[::-1], strict=True):
        turn = np.array([[np.cos(arc), -np.sin(arc)], [np.sin(arc), np.cos(arc)]])
        start = [u, 0.0] + turn @ (start - [u, 0.0])
    up, down = (lambda t, x, p, u=u: jnp.stack([x[1], u - x[0]]) for u in (1.0, -1.0))
    data, tf = [LASTING, sf.TerminalConstraint(lambda x, p: x)], sf.Parameter(15.6, upper=37.0)
    run = sf.Experiment(data, ("down", "up") * 2, (1.0, 9.0, 10.5), 0.0, tf)
    return sf.Problem(sf.HybridSystem({"up": up, "down": down}, start.tolist()), run)


def test_a_fit_that_ends_where_constraints_are_not_met_is_not_taken_for_a_better_one():
    """From there two modes collapse: J = 2.7 s is less than 9.3 s, and far from rest."""
    problem, start = pendulum(), [0.467, 3.036, 4.731, 5.951]
    alone = sf.estimate(problem, start=start, strategy="local")
    assert alone.status.name == "INFEASIBLE"
    assert alone.cost < 9.0
    found = sf.estimate(problem, start=start)
    np.testing.assert_allclose(found.theta, np.cumsum(PENDULUM_ARCS), rtol=0, atol=1e-6)
    assert found.steps[-1].strategy == "many starts"


@pytest.mark.slow
def test_a_slower_way_is_left_for_the_fastest():
    """With a full turn more in the second arc it takes 2 pi longer: a minimum nearby, and no better one is."""
    longer = np.cumsum([1.0, 3 * np.pi, np.pi, 2.0])
    alone = sf.estimate(pendulum(), start=longer, strategy="local")
    assert alone.status.name == "CONVERGED"
    assert alone.cost == pytest.approx(sum(PENDULUM_ARCS) + 2 * np.pi, abs=1e-6)
    # Those that ended at slower ways before do not count against it.
    found = fit_problem(pendulum(), start=longer, level="good")
    assert found.cost == pytest.approx(sum(PENDULUM_ARCS), abs=1e-6)


def straight(target=1.0, min_duration=0.0, **bounds):
    """x' = 1, and a cost of how far x(tf) is from a target."""
    system = sf.HybridSystem({"goes": lambda t, x, p: jnp.ones(1)}, [0.0])
    cost = sf.TerminalCost(lambda x, p: (x[0] - target) ** 2)
    run = sf.Experiment(cost, ("goes",), (), 0.0, sf.Parameter(**({"value": 2.0, "upper": 4.0} | bounds)))
    return sf.Problem(system, run, min_duration=min_duration)


@pytest.mark.parametrize(
    ("settings", "end", "active"),
    [
        ({}, 1.0, []),
        ({"target": 7.0}, 4.0, [("tf at its upper bound 4", 6.0)]),
        ({"lower": 1.5}, 1.5, [("tf at its lower bound 1.5", 1.0)]),
        ({"min_duration": 1.25}, 1.25, [("mode 1 ('goes') is at its minimum duration", 0.5)]),
    ],
)
def test_bounds_and_minimum_duration_hold_tf(settings, end, active):
    fit = sf.estimate(straight(**settings))
    assert fit.theta == pytest.approx([end], abs=1e-12 if active else 1e-8)
    assert [(str(constraint), pytest.approx(constraint.multiplier)) for constraint in fit.active] == active


def test_a_last_mode_that_vanishes_is_reported_as_collapsed():
    """x rises at 1, then at 1/2: the way to 1 is short in the first mode, which then takes all of the time."""
    system = sf.HybridSystem({"fast": lambda t, x, p: jnp.ones(1), "slow": lambda t, x, p: 0.5 * jnp.ones(1)}, [0.0])
    data, tf = [LASTING, sf.TerminalConstraint(lambda x, p: x - 1.0)], sf.Parameter(1.5, upper=4.0)
    fit = sf.estimate(sf.Problem(system, sf.Experiment(data, ("fast", "slow"), (0.5,), 0.0, tf)))
    np.testing.assert_allclose(fit.theta, [1.0, 1.0], rtol=0, atol=1e-8)
    assert [(c.kind, c.mode, c.position) for c in fit.active] == [("collapsed", "slow", 1)]


# --- errors -----------------------------------------------------------------------------------------------------------


GRID = np.linspace(0.0, 4.0, 9)
SIGNAL = sf.ReferenceSignal.from_samples(GRID, GRID[:, None])
LONG = sf.ReferenceSignal.from_samples(np.linspace(0.0, 5.0, 5), np.zeros((5, 1)))
SHORT = sf.Input(GRID, GRID, kind="linear")


def cool(data=SIGNAL, sequence=("cools",), times=(), **given):
    return sf.Experiment(data, sequence, times, 0.0, sf.Parameter(3.0, lower=2.0, upper=5.0), **given)


def cool_until(**tf):
    return cooling_run(tf=sf.Parameter(**{"value": 5.0, "upper": 9.0} | tf))


test_what_a_free_tf_does_not_allow_is_refused = refused(
    (lambda: cool_until(upper=np.inf), "A free tf needs a finite upper bound, .*; got the upper bound inf"),
    (lambda: cool_until(lower=1.5), "1.5, the lower bound of tf.; 5 of 20 do not, the first is"),
    (lambda: cool_until(lower=2.0, unit="h"), "tf has the unit 'h', but time_unit of .* is 's'"),
    (lambda: cool(), r"over \(t0, tf\) = \(0.0, 5.0, the upper bound of tf\)"),
    (lambda: cool(LONG, inputs=SHORT), r"Input must be known over \(t0, tf\) = \(0.0, 5.0\)"),
    (lambda: sf.simulate(minimum_time(), [1.0, 5.5]), r"\(t0, tf\) = \(0.0, 5.0\), with the upper bound"),
    (lambda: sf.simulate(minimum_time(), [2.0, 1.5]), "must not decrease"),
    (lambda: sf.estimate(cooling()).profile("tf"), "a profile does not support guards and terminal constraints"),
    error=ValueError,
)


def test_a_fast_lag_is_followed_up_to_the_end():
    """Its explicit steps are as long as stability allows, and none is needed behind tf: nodes that are less dense than
    they are have J = 1e19 at the guess, and a minimum where the force vanishes."""

    def drive(force):
        return lambda t, x, p: jnp.stack([x[1], x[2], 100.0 * (force(p) - x[2])])

    system = sf.HybridSystem({"push": drive(lambda p: p["F"]), "brake": drive(lambda p: -1.0)}, [0.0, 0.0, 0.0])
    arrive = sf.TerminalCost(lambda x, p: 50.0 * ((x[0] - 2.0) ** 2 + x[1] ** 2))
    hurry = sf.RunningCost(lambda t, x, p: 1.0 + 0.2 * x[2] ** 2)
    run = sf.Experiment([arrive, hurry], ("push", "brake"), (1.2,), 0.0, sf.Parameter(2.6, lower=0.5, upper=10.0))
    explicit, implicit = (sf.Problem(system, run, {"F": 1.0}, solver=solver) for solver in ("explicit", "stiff"))
    found, expected = sf.evaluate(explicit), sf.evaluate(implicit)
    assert found.cost == pytest.approx(expected.cost, rel=1e-7)
    np.testing.assert_allclose(found.gradient, expected.gradient, rtol=1e-5, atol=1e-5)
    theta = sf.estimate(implicit, strategy="local").theta
    np.testing.assert_allclose(sf.estimate(explicit, strategy="local").theta, theta, rtol=1e-5)
