"""Guards and terminal constraints: derivatives against closed forms and JAX, fits with known answers."""

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.derivatives import differentiate
from support.models import ball, ball_system, decay, fit_problem, refused, rest

# --- known answers ----------------------------------------------------------------------------------------------------


GROUND = {("air", "air"): lambda t, x, p: x[0]}
"""An impact is where the height is 0."""


def guarded_ball(times=(3.0, 8.0, 12.0)):
    """SciML's problem: the restitution is to bring a dropped ball to 20 m at 15 s."""
    return ball(times, system=ball_system(guards=GROUND))


def test_bouncing_ball_is_fitted_to_twelve_digits():
    fit = fit_problem(guarded_ball(), success=True)
    assert fit.parameters["e"] == pytest.approx(0.86655410543691079, abs=1e-12)
    assert max(abs(value) for _, value, _ in fit.constraints) < 1e-9
    assert "guard of tau_2 (air -> air)" in str(fit)
    # One unknown is left free, and J bends upwards in it.
    assert fit.free_basis.shape == (4, 1)
    assert (fit.free_basis.T @ fit.hessian @ fit.free_basis)[0, 0] > 0


AMICI = {"alpha": np.log(2), "beta": np.log(4), "gamma": np.log(3), "delta": 1.0, "eta": 0.5, "zeta": 0.25}


def amici():
    """x1 grows until t reaches x2, then decays; x2 grows until delta, then in proportion to time (AMICI's test)."""
    system = sf.HybridSystem(
        {
            "early": lambda t, x, p: jnp.stack([p["alpha"] * x[0], p["gamma"] * x[1]]),
            "growth": lambda t, x, p: jnp.stack([p["alpha"] * x[0], p["eta"] + 0 * x[1]]),
            "decay": lambda t, x, p: jnp.stack([-p["beta"] * x[0], p["eta"] + 0 * x[1]]),
        },
        lambda p: jnp.stack([p["zeta"], 1.0 + 0 * p["zeta"]]),
        guards={("early", "growth"): lambda t, x, p: t - p["delta"], ("growth", "decay"): lambda t, x, p: t - x[1]},
    )
    run = sf.Experiment(sf.TerminalCost(lambda x, p: x[0]), ("early", "growth", "decay"), (1.1, 4.5), 0.0, 10.0)
    return sf.Problem(system, run, AMICI, rtol=1e-12, atol=1e-14)


def test_events_of_amici_to_twelve_digits():
    found = sf.evaluate_on_guards(amici())

    def closed(q):
        alpha, beta, gamma, delta, eta, zeta = q
        event = (jnp.exp(gamma * delta) - eta * delta) / (1 - eta)
        return zeta * jnp.exp(alpha * event - beta * (10 - event))

    _, _, hessian = differentiate(closed, list(AMICI.values()))
    np.testing.assert_allclose(found.times, [1.0, 5.0], rtol=1e-12)
    assert found.cost == pytest.approx(0.0078125, rel=1e-11)
    published = [0.0390625, -0.0390625, 0.09747382226625, 0.09084030192077, 0.12996509635499, 0.03125]
    np.testing.assert_allclose(found.gradient, published, rtol=0, atol=2e-12)
    np.testing.assert_allclose(found.hessian, hessian, rtol=0, atol=1e-10)


TANK_TIMES = np.linspace(0.25, 10.0, 40)
TANK = sf.HybridSystem(
    {"fills": lambda t, x, p: jnp.stack([p["inflow"] - 0.1 * x[0]]), "overflows": rest},
    [0.0],
    guards={("fills", "overflows"): lambda t, x, p: x[0] - p["rim"]},
)


def fill_tank(inflow=0.5, guess=3.0, noise=0.0, **more):
    """A tank fills until it overflows: when depends on the inflow and on the height of the rim."""
    level = np.minimum(10 * inflow * (1 - np.exp(-0.1 * TANK_TIMES)), 2.2)
    data = sf.Measurements(TANK_TIMES, level + noise, sigma=0.02)
    return sf.Experiment(data, ("fills", "overflows"), (guess,), 0.0, 10.0, **more)


def tank(inflow=0.8, rim=None, **more):
    rim = sf.Parameter(1.5, lower=0.0) if rim is None else rim
    return sf.Problem(TANK, fill_tank(**more), {"inflow": inflow, "rim": rim})


def test_a_tank_that_overflows_is_fitted_with_the_covariance_of_its_closed_form():
    fit = fit_problem(tank(), level="good")  # not: the cost does not depend on the rim
    assert sf.identifiability(tank()).undetermined == 0
    overflow = -10 * np.log(1 - 2.2 / 5)
    np.testing.assert_allclose(fit.theta, [overflow, 0.5, 2.2], rtol=0, atol=1e-8)
    filling, grown = overflow > TANK_TIMES, 10 * (1 - np.exp(-0.1 * TANK_TIMES))
    slopes = np.stack([np.where(filling, grown, 0.0), np.where(filling, 0.0, 1.0)], axis=1)
    covariance = 0.02**2 * np.linalg.inv(slopes.T @ slopes)
    np.testing.assert_allclose(fit.covariance[1:, 1:], covariance, rtol=1e-6, atol=1e-15)
    # The overflow's time follows from both: inflow = rim / (10 (1 - exp(-t/10))).
    by_rim = 1 / (0.5 * np.exp(-0.1 * overflow))
    gradient = np.array([-(1 - np.exp(-0.1 * overflow)) * 10 * by_rim, by_rim])
    assert fit.covariance[0, 0] == pytest.approx(gradient @ covariance @ gradient, rel=1e-6)


@pytest.mark.parametrize("count", [2, 17])
def test_many_guarded_runs_are_fitted_jointly(count):
    """Tanks with one rim, each with an inflow of its own; 16 runs or more have another shape without guards."""
    inflows = np.random.default_rng(3).uniform(0.4, 0.8, count)
    own = {f"inflow_{i}": 0.7 for i in range(count)}
    runs = [fill_tank(q, 4.0, parameter_map={"inflow": name}) for q, name in zip(inflows, own, strict=True)]
    fit = sf.estimate(sf.Problem(TANK, runs, {"rim": sf.Parameter(1.5, lower=0.0), **own}), strategy="local")
    assert fit.success
    assert [name for name, _, _ in fit.constraints][1:2] == ["run2.guard of tau_1 (fills -> overflows)"]
    np.testing.assert_allclose(list(fit.parameters.values()), [2.2, *inflows], rtol=0, atol=1e-8)
    times = np.concatenate(fit.transition_times)
    np.testing.assert_allclose(times, -10 * np.log(1 - 0.22 / inflows), atol=1e-7)
    np.testing.assert_allclose(sf.evaluate_on_guards(fit.problem, fit.theta).times, times, atol=1e-7)


def test_unknowns_on_a_logarithmic_scale_are_fitted_beside_guards():
    """The optimiser works in their logarithms: the end, the multiplier and the covariance are those of the unknowns."""
    noise = 0.02 * np.random.default_rng(4).standard_normal(40)
    one = sf.estimate(tank(noise=noise))
    other = sf.estimate(tank(sf.Parameter(0.8, scale="log"), sf.Parameter(1.5, scale="log"), noise=noise))
    np.testing.assert_allclose(other.theta, one.theta, rtol=1e-7)
    np.testing.assert_allclose(other.hessian, one.hessian, rtol=1e-6, atol=1e-6 * np.abs(one.hessian).max())
    np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-5, atol=1e-12)
    assert other.constraints[0][2] == pytest.approx(one.constraints[0][2], rel=1e-5, abs=1e-6)


# --- what can go wrong ------------------------------------------------------------------------------------------------


def constrain(psi):
    """Pose a problem with this terminal constraint."""
    data = [sf.TerminalCost(lambda x, p: p["k"] ** 2), sf.TerminalConstraint(psi)]
    system = sf.HybridSystem({"decay": decay}, [1.0])
    return sf.Problem(system, sf.Experiment(data, ("decay",), (), 0.0, 1.0), {"k": sf.Parameter(1.0, 0.1, 5.0)})


def test_constraints_that_cannot_be_met_are_named():
    fit = fit_problem(constrain(lambda x, p: x[0] + 1.0), status=sf.Status.INFEASIBLE, success=False)
    assert "The constraints are not met: terminal constraint 1 = 1.0" in fit.message


HIGH = ball_system(guards={("air", "air"): lambda t, x, p: x[0] - 60.0})
BELOW = ball_system(guards={("air", "air"): lambda t, x, p: x[0] < 0.0})
FIXED = guarded_ball((sf.Parameter(3.2, fixed=True),))
test_what_is_wrong_is_said = refused(
    (lambda: sf.evaluate_on_guards(ball((3.0,), system=HIGH)), "No transition times near .* put tau_1 on their"),
    (lambda: sf.evaluate_on_guards(ball((3.0,))), "This problem has no guards"),
    (lambda: sf.evaluate_on_guards(FIXED), "A transition with a guard cannot have a fixed time"),
    (lambda: sf.estimate(tank(), hessian="none"), r"hessian must be ('auto' or 'exact'|one of)"),
    (lambda: ball_system(guards={("air", "c"): abs}), "guards names the unknown mode 'c'; the modes are air"),
    (lambda: ball_system(guards={("air", "air"): 3.0}), r"guard \('air', 'air'\) must be a function g\(t, x, p\)"),
    (lambda: sf.estimate(ball((3.0,), system=BELOW)), r"guard \('air', 'air'\): .* not a comparison"),
    (lambda: sf.TerminalConstraint(3), r"TerminalConstraint must be a function psi\(x, p\); got 3"),
    (lambda: constrain(lambda x, p: jnp.ones((2, 2)) * x[0]), r"must return a number or \(m,\) of them; got \(2, 2\)"),
)
