"""Samplers on posteriors with kinks: effective samples per second, divergences, and how far they are from quadrature.

``python -m benchmarks.samplers`` prints the figures of docs/sampling.md. The slope of the log posterior jumps where a
transition time passes a sample. Truth is quadrature on a grid, which uses no sampler and no derivative.
"""

from __future__ import annotations

import runpy
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import switchfit as sf
from switchfit.batch.posterior import LogPosterior
from switchfit.paper.vehicle import TRUTH, position, positions_at, simulate_drive, stick_slip

CHAINS, WARMUP, DRAWS = 4, 500, 2000
WALKERS = 32
EXAMPLE = Path(__file__).parent.parent / "examples" / "uncertainty.py"


class Laplace(NamedTuple):
    """The normal density with the mode and the curvature of a posterior in z: what a sampler would do without kinks."""

    center: Any
    precision: Any

    @classmethod
    def of(cls, posterior: LogPosterior) -> Laplace:
        z = jnp.array(posterior.start)
        return cls(z, -jax.hessian(posterior.log_density)(z))

    def log_density(self, z: Any) -> Any:
        return -0.5 * (z - self.center) @ self.precision @ (z - self.center)

    def constrain(self, z: Any) -> Any:
        return np.asarray(z)


class Run(NamedTuple):
    """Draws of theta (chains, draws, d), seconds of sampling and of compiling, divergent steps, evaluations."""

    theta: Any
    seconds: float
    compiling: float
    divergences: int | None
    evaluations: int | None


def vehicle(noise: float = 0.1) -> sf.Problem:
    """The vehicle of the paper: positions at 10 Hz with noise of 0.1 m."""
    times = np.linspace(0.1, 15.0, 150)
    xy = positions_at(simulate_drive(), times) + noise * np.random.default_rng(1).standard_normal((150, 2))
    return stick_slip(sf.Measurements(times, xy, observe=position, sigma=noise, names=("X", "Y")), TRUTH)


def room() -> sf.Problem:
    """The room of docs/uncertainty.md: a sample lies within the interval of its transition time."""
    return runpy.run_path(str(EXAMPLE))["problem"]


def ramp() -> sf.Problem:
    """A ramp that ends among eight readings: its end and its slope, with a kink in the middle of the posterior."""
    times = np.arange(0.5, 8.0)
    true = np.minimum(times, 3.45)
    data = sf.Measurements(times, true + 0.3 * np.random.default_rng(3).standard_normal(len(times)), sigma=0.3)
    system = sf.HybridSystem({"rise": lambda t, x, p: p["rate"] + 0.0 * x, "rest": lambda t, x, p: 0.0 * x}, [0.0])
    return sf.Problem(system, sf.Experiment(data, ("rise", "rest"), (3.2,), 0.0, 8.0), {"rate": sf.Parameter(1.0)})


PROBLEMS: dict[str, Callable[[], sf.Problem]] = {"ramp": ramp, "room": room, "vehicle": vehicle}


def integrate(posterior: LogPosterior, fit: sf.Estimate, points: int, reach: float = 6.0) -> tuple[Any, Any]:
    """Return mean and standard deviation of theta by the trapezoidal rule on a grid (whitened by the covariance)."""
    d = len(fit.theta)
    root = np.linalg.cholesky(fit.covariance)
    axis = np.linspace(-reach, reach, points)
    grid = np.stack(np.meshgrid(*[axis] * d, indexing="ij"), axis=-1).reshape(-1, d)
    thetas = fit.theta + grid @ root.T
    density = jax.jit(lambda all_: jax.lax.map(posterior, all_))
    found = np.asarray(density(jnp.asarray(thetas)))
    weight = np.exp(found - found.max())
    weight /= weight.sum()
    mean = weight @ thetas
    return mean, np.sqrt(weight @ (thetas - mean) ** 2)


def run_with_numpyro(kind: str, chains: int = CHAINS, **settings: Any) -> Callable[..., Run]:
    """Return a kernel of NumPyro: NUTS; AIES, the affine-invariant ensemble; or ESS, ensemble slice sampling."""

    def run(posterior: LogPosterior, starts: Any, key: Any) -> Run:
        import numpyro

        kernel = getattr(numpyro.infer, kind)(potential_fn=lambda z: -posterior.log_density(z), **settings)
        alone = chains == CHAINS  # an ensemble is one state of all its walkers

        def one(key: Any, start: Any) -> tuple[Any, Any]:
            state = kernel.init(key if alone else jax.random.split(key, chains), WARMUP, start, (), {})

            def step(state: Any, _: Any) -> Any:
                state = kernel.sample(state, (), {})
                return state, ((state.z, state.diverging, state.num_steps) if alone else (state.z, False, 0))

            z, diverging, count = jax.lax.scan(step, state, length=WARMUP + DRAWS)[1]
            return z[WARMUP:], diverging[WARMUP:], count[WARMUP:]

        if alone:
            return _measure(posterior, one, starts, key)
        found = _measure(posterior, one, starts[None, :chains], key)
        return found._replace(theta=np.swapaxes(found.theta[0], 0, 1), divergences=None, evaluations=None)

    return run


def run_blackjax_nuts(posterior: LogPosterior, starts: Any, key: Any) -> Run:
    """NUTS of BlackJAX with its window adaptation."""
    import blackjax

    def one(key: Any, start: Any) -> tuple[Any, Any]:
        warm, own = jax.random.split(key)
        adapt = blackjax.window_adaptation(blackjax.nuts, posterior.log_density, is_mass_matrix_diagonal=False)
        (state, parameters), _ = adapt.run(warm, start, num_steps=WARMUP)
        kernel = blackjax.nuts(posterior.log_density, **parameters)

        def step(state: Any, key: Any) -> Any:
            state, info = kernel.step(key, state)
            return state, (state.position, info.is_divergent, info.num_integration_steps)

        return jax.lax.scan(step, state, jax.random.split(own, DRAWS))[1]

    return _measure(posterior, one, starts, key)


def run_random_walk(posterior: LogPosterior, starts: Any, key: Any) -> Run:
    """Random-walk Metropolis of BlackJAX with the covariance of the fit, times 2.38**2 / d."""
    import blackjax

    size = 2.38 / np.sqrt(len(posterior.start))

    def one(key: Any, start: Any) -> tuple[Any, Any]:
        kernel = blackjax.additive_step_random_walk(
            posterior.log_density, lambda key, z: size * jax.random.normal(key, z.shape)
        )

        def step(state: Any, key: Any) -> Any:
            state, _ = kernel.step(key, state)
            return state, (state.position, False, 1)

        keys = jax.random.split(key, 10 * (WARMUP + DRAWS))
        z, no, count = jax.lax.scan(step, kernel.init(start), keys)[1]
        return z[10 * WARMUP :], no, count[10 * WARMUP :]

    return _measure(posterior, one, starts, key)._replace(divergences=None)


def _measure(posterior: LogPosterior, one: Callable[..., Any], starts: Any, key: Any) -> Run:
    """Compile a chain, run it for all starts, and run it again with the clock."""
    starts = starts[:CHAINS]
    program = jax.jit(lambda keys, starts: jax.lax.map(lambda given: one(*given), (keys, starts)))
    keys = jax.random.split(key, 2 * len(starts))
    begin = time.perf_counter()
    compiled = program.lower(keys[: len(starts)], starts).compile()
    compiling = time.perf_counter() - begin
    begin = time.perf_counter()
    z, diverging, count = jax.block_until_ready(compiled(keys[len(starts) :], starts))
    seconds = time.perf_counter() - begin
    return Run(posterior.constrain(np.asarray(z)), seconds, compiling, int(np.sum(diverging)), int(np.sum(count)))


SAMPLERS = {
    "NUTS (NumPyro)": run_with_numpyro("NUTS", dense_mass=True),
    "NUTS (BlackJAX)": run_blackjax_nuts,
    "random walk with the covariance of the fit (BlackJAX)": run_random_walk,
    "ensemble, AIES (NumPyro)": run_with_numpyro("AIES", WALKERS),
    "ensemble slice, ESS (NumPyro)": run_with_numpyro("ESS", WALKERS),
}


def tabulate() -> Iterator[str]:
    """Yield the lines of the table."""
    yield (
        "| posterior | sampler | effective per second | per 1000 evaluations | R-hat | divergences | mean off (sd) "
        "| sd off | compiling |"
    )
    yield "|---|---|---|---|---|---|---|---|---|"
    for name, build in PROBLEMS.items():
        fit = sf.estimate(build())
        posterior = sf.log_posterior(fit)
        mean, sd = integrate(posterior, fit, {2: 801, 3: 81}[len(fit.theta)])
        rng = np.random.default_rng(0)
        cloud = fit.theta + 0.5 * rng.standard_normal((WALKERS, len(fit.theta))) @ np.linalg.cholesky(fit.covariance).T
        starts = jnp.array([posterior.unconstrain(theta) for theta in cloud])
        control = run_with_numpyro("NUTS", dense_mass=True)(Laplace.of(posterior), starts, jax.random.key(0))  # type: ignore[arg-type]
        import arviz

        table = arviz.from_dict({name: control.theta[..., k] for k, name in enumerate(posterior.names)})

        ess = min(float(arviz.ess(table)[unknown]) for unknown in posterior.names)
        rate = f"{1000 * ess / (control.evaluations or 1):.0f}"
        yield f"| {name} | NUTS (NumPyro) on its Laplace approximation, which has no kinks | | {rate} | | | | | |"
        for label, run in SAMPLERS.items():
            done = run(posterior, starts, jax.random.key(0))
            table = arviz.from_dict({name: done.theta[..., k] for k, name in enumerate(posterior.names)})
            ess = min(float(arviz.ess(table)[unknown]) for unknown in posterior.names)
            rhat = max(float(arviz.rhat(table)[unknown]) for unknown in posterior.names)
            flat = np.reshape(done.theta, (-1, len(sd)))
            off, wide = np.abs(flat.mean(0) - mean) / sd, np.abs(flat.std(0) / sd - 1)
            rate = "" if done.evaluations is None else f"{1000 * ess / done.evaluations:.0f}"
            count = "" if done.divergences is None else f"{done.divergences} of {CHAINS * DRAWS}"
            yield (
                f"| {name} | {label} | {ess / done.seconds:,.0f} | {rate} | {rhat:.3f} | {count} | {off.max():.3f} "
                f"| {100 * wide.max():.1f} % | {done.compiling:.0f} s |"
            )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for line in tabulate():
        print(line, flush=True)
