"""The log posterior: derivatives, the change of variables, and samplers against quadrature on a grid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from switchfit.batch.posterior import EDGE
from switchfit.models import heater_problem

RAMP = sf.HybridSystem({"rise": lambda t, x, p: p["rate"] + 0.0 * x, "rest": lambda t, x, p: 0.0 * x}, [0.0])
TIMES = np.arange(0.5, 8.0)
NOISE = 0.3
VALUES = np.minimum(TIMES, 3.45) + NOISE * np.random.default_rng(3).standard_normal(len(TIMES))


@pytest.fixture(autouse=True)
def float64():
    """What samplers need throughout."""
    with jax.enable_x64(True):
        yield


def ramp(rate=None, sigma=NOISE, **settings):
    """A ramp that ends at tau among eight samples: kinks in the middle of its posterior."""
    data = sf.Measurements(TIMES, VALUES, sigma=sigma)
    rate = sf.Parameter(1.0, **settings) if rate is None else rate
    parameters = {"rate": rate} | ({sigma: sf.Parameter(0.3, lower=0.01)} if isinstance(sigma, str) else {})
    return sf.Problem(RAMP, sf.Experiment(data, ("rise", "rest"), (3.3,), 0.0, 8.0), parameters)


def by_hand(tau, rate):
    """The log density of the ramp in closed form, without the constant."""
    return -0.5 * np.sum((VALUES - rate * np.minimum(TIMES, np.asarray(tau)[..., None])) ** 2, axis=-1) / NOISE**2


def chain(count, **settings):
    """A sequence of modes with so many transitions; entries may be given."""
    modes = [("rise", "rest")[k % 2] for k in range(count + 1)]
    data = sf.Measurements(TIMES, VALUES, sigma=NOISE)
    times = settings.pop("times", np.linspace(1.0, 6.0, count).tolist())
    return sf.Problem(RAMP, sf.Experiment(data, modes, times, 0.0, 8.0), {"rate": 1.0}, **settings)


@pytest.mark.parametrize("engine", ["auto", pytest.param("jax", marks=pytest.mark.slow)])
def test_value_gradient_and_hessian_are_those_of_the_cost(engine):
    base = heater_problem()
    problem = sf.Problem(base.system, base.experiments, base.parameters, engine=engine)
    posterior = sf.log_posterior(problem)
    theta = jnp.array([2.33, 0.41])
    exact = sf.evaluate(problem, theta)
    assert float(posterior(theta)) == pytest.approx(-exact.cost, rel=1e-12)
    orders = (jax.grad, jax.hessian, jax.jacfwd)
    gradient, hessian, forward = jax.jit(lambda theta: [derive(posterior)(theta) for derive in orders])(theta)
    np.testing.assert_allclose(gradient, -exact.gradient, rtol=1e-10)
    np.testing.assert_allclose(hessian, -exact.hessian, rtol=1e-10)
    np.testing.assert_allclose(forward, -exact.gradient, rtol=1e-10)
    many = jnp.array(np.asarray(theta) + 0.01 * np.arange(6.0).reshape(3, 2))
    loop = [float(posterior(one)) for one in many]
    np.testing.assert_allclose(jax.jit(jax.vmap(posterior))(many), loop, rtol=1e-12)
    slopes = [jax.grad(posterior)(one) for one in many]
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.grad(posterior)))(many), slopes, rtol=1e-10)


def test_several_runs_with_priors_and_shared_parameters():
    data = sf.Measurements(TIMES, VALUES, sigma=NOISE)
    fixed = sf.Parameter(3.4, fixed=True)
    runs = [sf.Experiment(data, ("rise", "rest"), (tau,), 0.0, 8.0) for tau in (3.3, fixed, 3.1)]
    rate = sf.Parameter(1.0, prior=sf.Normal(0.8, 0.05))
    posterior = sf.log_posterior(sf.Problem(RAMP, runs, {"rate": rate}))
    assert posterior.names == ("run1.tau_1", "run3.tau_1", "rate")
    for first, third in ((3.2, 3.6), (3.49, 5.2), (3.5, 0.7)):
        expected = by_hand(first, 0.95) + by_hand(3.4, 0.95) + by_hand(third, 0.95) - 0.5 * 9.0
        assert float(posterior([first, third, 0.95])) == pytest.approx(expected, rel=1e-9)


def test_a_sigma_that_is_a_parameter():
    posterior = sf.log_posterior(ramp(sigma="noise"))
    expected = by_hand(3.4, 1.0) * NOISE**2 / 0.4**2 - len(TIMES) * np.log(0.4)
    reference = by_hand(3.4, 1.0) - len(TIMES) * np.log(NOISE)
    change = float(posterior([3.4, 1.0, 0.4])) - float(posterior([3.4, 1.0, NOISE]))
    assert change == pytest.approx(expected - reference, rel=1e-9)


def test_outside_the_bounds_the_density_is_zero_and_has_no_slope():
    posterior = sf.log_posterior(chain(2, min_duration=0.5))
    for theta in ([-0.1, 3.0, 1.0], [3.0, 2.0, 1.0], [3.0, 8.1, 1.0], [3.0, 3.4, 1.0], [0.4, 3.0, 1.0]):
        assert posterior(theta) == -np.inf
        assert np.all(np.isfinite(jax.grad(posterior)(jnp.array(theta))))
    assert np.isfinite(posterior([3.0, 3.6, 1.0]))
    bounded = sf.log_posterior(ramp(lower=0.5, upper=1.5))
    assert bounded([3.0, 1.6]) == -np.inf < bounded([3.0, 1.4])


def test_what_cannot_be_integrated_has_a_density_of_zero():
    system = sf.HybridSystem({"m": lambda t, x, p: p["a"] * x**2}, [1.0])
    run = sf.Experiment(sf.Measurements([0.5, 1.0], [1.1, 1.2], sigma=0.1), ("m",), (), 0.0, 1.0)
    posterior = sf.log_posterior(sf.Problem(system, run, {"a": 0.1}))
    assert posterior([60.0]) == -np.inf
    assert np.all(np.isfinite(jax.grad(posterior)(jnp.array([60.0]))))


CASES = {
    "bounds": lambda: ramp(lower=0.5, upper=1.5),
    "lower": lambda: ramp(lower=0.5),
    "upper": lambda: ramp(upper=1.5),
    "log": lambda: ramp(scale="log"),
    "minimum duration": lambda: chain(3, min_duration=0.4),
    "fixed between": lambda: chain(3, times=[1.0, sf.Parameter(3.0, fixed=True), 5.0], min_duration=0.2),
    "bounds of times": lambda: chain(3, times=[sf.Parameter(1.0, 0.5, 2.5), sf.Parameter(3.0, 2.0, 4.0), 5.0]),
    "an estimate": lambda: sf.estimate(heater_problem()),
}


@pytest.mark.parametrize("case", CASES)
def test_the_change_of_variables(case):
    """Any z is inside all constraints, comes back, and its volume is that of the Jacobian."""
    given = CASES[case]()
    posterior, problem = sf.log_posterior(given), getattr(given, "problem", given)
    unknowns = problem.unknowns
    rng = np.random.default_rng(0)
    evaluate = jax.jit(lambda z: (jax.jacfwd(posterior.constrain)(z), posterior.log_density(z)))
    for z in rng.normal(scale=2.0, size=(20, len(problem.theta_names))):
        theta = posterior.constrain(z)
        assert np.all(unknowns.A @ theta > unknowns.b)
        assert np.all((theta > unknowns.lower) & (theta < unknowns.upper))
        np.testing.assert_allclose(posterior.unconstrain(theta), z, rtol=1e-7, atol=1e-7)
        slope, density = evaluate(z)
        volume = np.linalg.slogdet(slope)[1]
        assert float(density) == pytest.approx(float(posterior(theta)) + volume, rel=1e-9)
    start = getattr(given, "theta", problem.initial_theta)
    np.testing.assert_allclose(posterior.constrain(posterior.start), start, rtol=1e-10)
    assert posterior.constrain(np.zeros((2, 3, len(problem.theta_names)))).shape == (2, 3, len(problem.theta_names))


def test_an_unknown_at_a_kink_has_the_width_of_its_interval():
    """At a kink it has no variance."""
    values = np.minimum(TIMES, 3.5)
    data = sf.Measurements(TIMES, values + np.array([0, 0, 0, 0.2, 0, 0, 0, 0]), sigma=NOISE)
    problem = sf.Problem(
        RAMP, sf.Experiment(data, ("rise", "rest"), (3.3,), 0.0, 8.0), {"rate": sf.Parameter(1.0, fixed=True)}
    )
    fit = sf.estimate(problem)
    assert fit.kinks
    low, high = fit.confidence_intervals()[0]
    slope = np.array(jax.jacfwd(sf.log_posterior(fit).constrain)(jnp.zeros(1)))[0, 0]
    assert slope == pytest.approx((high - low) / 4, rel=1e-6)


def test_unknowns_on_a_logarithmic_scale_are_flat_in_their_logarithm():
    flat, log = sf.log_posterior(ramp(lower=1e-9)), sf.log_posterior(ramp(scale="log"))
    for rate in (0.5, 2.0):
        assert float(log([3.3, rate])) == pytest.approx(float(flat([3.3, rate])) - np.log(rate), rel=1e-12)
    prior = sf.log_posterior(ramp(scale="log", prior=sf.LogNormal(1.0, 0.2)))
    expected = by_hand(3.3, 1.5) - 0.5 * (np.log(1.5) / 0.2) ** 2 - np.log(1.5)
    assert float(prior([3.3, 1.5])) == pytest.approx(expected, rel=1e-9)


def test_a_theta_on_a_bound_is_moved_inside():
    posterior = sf.log_posterior(ramp(lower=0.5, upper=1.5))
    theta = posterior.constrain(posterior.unconstrain([0.0, 1.5]))
    np.testing.assert_allclose(theta, [8 * EDGE, 1.5 - EDGE], rtol=1e-6)


def integrate(posterior, center, reach):
    """Mean and standard deviation of theta (2,) by the trapezoidal rule in closed form, without the library."""
    tau, rate = (np.linspace(c - r, c + r, 1201) for c, r in zip(center, reach, strict=True))
    grid = np.stack(np.meshgrid(tau, rate, indexing="ij"), axis=-1)
    density = -0.5 * np.sum((VALUES - grid[..., 1:] * np.minimum(TIMES, grid[..., :1])) ** 2, axis=-1) / NOISE**2
    weight = np.exp(density - density.max())
    weight /= weight.sum()
    mean = np.einsum("ij,ijk->k", weight, grid)
    return mean, np.sqrt(np.einsum("ij,ijk->k", weight, (grid - mean) ** 2))


@pytest.mark.slow
@pytest.mark.promotes  # NumPyro itself does
def test_nuts_finds_the_posterior_of_quadrature_without_divergences():
    numpyro = pytest.importorskip("numpyro")
    fit = sf.estimate(ramp())
    posterior = sf.log_posterior(fit)
    mean, sd = integrate(posterior, fit.theta, 7 * fit.standard_errors)
    kernel = numpyro.infer.NUTS(potential_fn=lambda z: -posterior.log_density(z))
    mcmc = numpyro.infer.MCMC(kernel, num_warmup=500, num_samples=4000, progress_bar=False)
    mcmc.run(jax.random.key(1), init_params=jnp.array(posterior.start), extra_fields=("diverging",))
    thetas = posterior.constrain(np.asarray(mcmc.get_samples()))
    assert not np.asarray(mcmc.get_extra_fields()["diverging"]).any()
    assert np.all(np.abs(thetas.mean(axis=0) - mean) < 0.12 * sd)
    np.testing.assert_allclose(thetas.std(axis=0), sd, rtol=0.1)


def test_single_precision_is_refused_inside_programs():
    posterior = sf.log_posterior(ramp())
    with jax.enable_x64(False):
        assert float(posterior([3.3, 1.0])) == pytest.approx(by_hand(3.3, 1.0), rel=1e-9)
        for program in (jax.jit(posterior), jax.grad(posterior.log_density)):
            with pytest.raises(ValueError, match="needs float64, which is not enabled"):
                program(jnp.array([3.3, 1.0]))


def experiment(*data):
    return sf.Experiment(list(data), ("rise", "rest"), (3.0,), 0.0, 8.0)


SAMPLES = sf.Measurements(TIMES, VALUES, sigma=NOISE)
AREA, END = sf.RunningCost(lambda t, x, p: x[0] ** 2), sf.TerminalConstraint(lambda x, p: x[0] - 3.0)
REFUSED = {
    r"log_posterior needs an sf.Problem or the result of sf.estimate; got 3": 3,
    "a posterior needs a cost of Measurements with sigma": ramp(sigma=None),
    "other terms are no probability": sf.Problem(RAMP, experiment(AREA), {"rate": 1.0}),
    "a posterior cannot have equality constraints; this problem has terminal": sf.Problem(
        RAMP, experiment(SAMPLES, END), {"rate": 1.0}
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_has_no_posterior(message):
    with pytest.raises((TypeError, ValueError), match=message):
        sf.log_posterior(REFUSED[message])


def test_of_an_estimate_with_a_mode_of_the_shortest_duration_z_is_free():
    """The covariance has no part across the constraint, although both transition times have a variance."""
    base = heater_problem()
    run = sf.Experiment(base.experiments[0].data, ("on", "off", "on", "off"), (1.0, 1.5, 2.4), 0.0, 6.0)
    fit = sf.estimate(sf.Problem(base.system, run, base.parameters, min_duration=0.3), strategy="local")
    assert fit.theta[1] - fit.theta[0] == pytest.approx(0.3, abs=1e-9)
    posterior = sf.log_posterior(fit)
    slope = np.array(jax.jacfwd(posterior.constrain)(jnp.zeros(4)))
    spread = slope @ slope.T
    others = np.ix_([0, 2, 3], [0, 2, 3])
    np.testing.assert_allclose(spread[others], fit.covariance[others], rtol=100 * EDGE)
    length = np.sqrt(spread[0, 0] - 2 * spread[0, 1] + spread[1, 1])
    assert length == pytest.approx(EDGE * (6.0 - 2 * 0.3 - fit.theta[0] - 0.3), rel=1e-3)  # z[1] has the size 1
