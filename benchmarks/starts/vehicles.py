"""Skid-steered vehicles: the paper's, and one that turns twice, from positions every half second."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from benchmarks import many, models, vehicle
from benchmarks.starts.case import Case, Collocated, Sampled, draw_anywhere, sample_states
from switchfit.models import skid_steer

LENGTH, WIDTH, GRAVITY, MASS = 0.25, 0.23, 9.81, 80.0
"""Half the wheelbase and half the track (m), m/s², kg."""
INERTIA = (4 * 2.5 * (12 * LENGTH**2 + 12 * WIDTH**2) + 70 * (0.89**2 + 0.55**2)) / 12
DRAG = 0.92
FORCES = (
    (0.0, 5.0, 10.0, 15.0, 19.0, 24.0),
    ((15.0,) * 4, (27.0, 0.0, 0.0, 27.0), (15.0,) * 4, (0.0, 27.0, 27.0, 0.0), (15.0,) * 4, (15.0,) * 4),
)
"""Times (s) and the four wheel forces (N) from each on."""
TWO_TURNS, TWO_TURNS_GUESS = np.array([5.3, 10.4, 15.3, 19.5, 0.8, 0.6, 0.72]), (5.05, 10.1, 15.1, 19.1, 0.7, 0.7, 1.0)
END, SIGMA = 24.0, 0.1


def two_turns(count: int = 40) -> Case:
    """Starts with the four times within half a second and the parameters within a factor of two or three."""
    problem = two_turns_problem()
    random = np.random.default_rng(0)
    starts = [
        [*np.sort(TWO_TURNS[:4] + random.uniform(-0.5, 0.5, 4)), *random.uniform(0.4, 1.2, 2), random.uniform(0.2, 2.0)]
        for _ in range(count)
    ]
    return Case(problem, TWO_TURNS, np.array(starts), noisy=True, collocation=_sample_two_turns(problem))


def two_turns_anywhere(count: int = 40) -> Case:
    """The same with the times anywhere in order."""
    random = np.random.default_rng(3)
    starts = [
        [*np.sort(random.uniform(0.0, END, 4)), *random.uniform(0.4, 1.2, 2), random.uniform(0.2, 2.0)]
        for _ in range(count)
    ]
    problem = two_turns_problem()
    return Case(problem, TWO_TURNS, np.array(starts), noisy=True, collocation=_sample_two_turns(problem))


def two_turns_problem(noise: int | None = 1) -> sf.Problem:
    """Four transition times, two frictions and a drag; `noise` is the seed of the noise."""
    times = np.arange(0.5, END + 0.25, 0.5)
    inputs = sf.Input(FORCES[0], np.array(FORCES[1]), kind="hold")

    def build(values: np.ndarray) -> sf.Problem:
        data = sf.Measurements(times, values, observe=many.positions, sigma=SIGMA, names=("X", "Y"))
        sequence = ("stick", "slip", "stick", "slip", "stick")
        run = sf.Experiment(data, sequence, TWO_TURNS_GUESS[:4], 0.0, END, inputs=inputs)
        mu_f, mu_r, c = TWO_TURNS_GUESS[4:]
        friction = {"lower": 0.05, "upper": 3.0}
        parameters = {
            "mu_f": sf.Parameter(mu_f, **friction),
            "mu_r": sf.Parameter(mu_r, **friction),
            "c": sf.Parameter(c, lower=0.0, upper=5.0, unit="kg/s"),
        }
        return sf.Problem(SLIPPING_AXLES, run, parameters)

    positions = sample_states(build(np.zeros((len(times), 2))), TWO_TURNS, times)[:, [0, 2]]
    if noise is not None:
        positions = positions + np.random.default_rng(noise).normal(0.0, SIGMA, positions.shape)
    return build(positions)


def stick(t: Any, x: Any, p: Any, u: Any) -> Any:
    """Straight on."""
    force = jnp.sum(u)
    return jnp.stack(
        [
            x[1],
            (force * jnp.cos(x[4]) - p["c"] * x[1]) / MASS,
            x[3],
            (force * jnp.sin(x[4]) - p["c"] * x[3]) / MASS,
            x[5],
            0.0 * x[5],
        ]
    )


def slip(t: Any, x: Any, p: Any, u: Any) -> Any:
    """Both axles slide sideways, each with a friction of its own."""
    sin, cos = jnp.sin(x[4]), jnp.cos(x[4])
    force, sideways = jnp.sum(u), -sin * x[1] + cos * x[3]
    front = -p["mu_f"] * GRAVITY * MASS / 2 * (sideways + LENGTH * x[5])
    rear = -p["mu_r"] * GRAVITY * MASS / 2 * (sideways - LENGTH * x[5])
    return jnp.stack(
        [
            x[1],
            (force * cos - DRAG * x[1] - (front + rear) * sin) / MASS,
            x[3],
            (force * sin - DRAG * x[3] + (front + rear) * cos) / MASS,
            x[5],
            (WIDTH * (u[0] - u[1] - u[2] + u[3]) + LENGTH * (front - rear)) / INERTIA,
        ]
    )


def grip(t: Any, x: Any, p: Any) -> Any:
    """The wheels grip: the speed sideways and the turning vanish."""
    sin, cos = jnp.sin(x[4]), jnp.cos(x[4])
    along = cos * x[1] + sin * x[3]
    return jnp.stack([x[0], along * cos, x[2], along * sin, x[4], 0.0 * x[5]])


def move_on_axles(mode: str, x: Sequence[Any], p: Sequence[Any], u: Sequence[Any], functions: Any) -> list[Any]:
    """Return `stick` and `slip` entry by entry, as the peers take them."""
    _, dX, _, dY, angle, turn = x
    mu_f, mu_r, c = p
    sin, cos, force = functions.sin(angle), functions.cos(angle), u[0] + u[1] + u[2] + u[3]
    if mode == "stick":
        return [dX, (force * cos - c * dX) / MASS, dY, (force * sin - c * dY) / MASS, turn, 0.0 * turn]
    sideways = -sin * dX + cos * dY
    front = -mu_f * GRAVITY * MASS / 2 * (sideways + LENGTH * turn)
    rear = -mu_r * GRAVITY * MASS / 2 * (sideways - LENGTH * turn)
    ddX = (force * cos - DRAG * dX - (front + rear) * sin) / MASS
    ddY = (force * sin - DRAG * dY + (front + rear) * cos) / MASS
    return [dX, ddX, dY, ddY, turn, (WIDTH * (u[0] - u[1] - u[2] + u[3]) + LENGTH * (front - rear)) / INERTIA]


def grip_axles(x: Sequence[Any], functions: Any) -> list[Any]:
    """Return `grip` entry by entry."""
    sin, cos = functions.sin(x[4]), functions.cos(x[4])
    along = cos * x[1] + sin * x[3]
    return [x[0], along * cos, x[2], along * sin, x[4], 0.0 * x[5]]


def _sample_two_turns(problem: sf.Problem) -> Sampled:
    """Return the two turns for a collocation."""
    return Sampled(
        problem,
        move_on_axles,
        observed=(0, 2),
        input_times=FORCES[0],
        inputs=np.array(FORCES[1]),
        resets={("slip", "stick"): grip_axles},
    )


SLIPPING_AXLES = sf.HybridSystem(
    {"stick": stick, "slip": slip},
    np.zeros(6),
    reset_maps={("slip", "stick"): grip},
    state_names=("X", "dX", "Y", "dY", "theta", "omega"),
)
PAPER = np.array([*vehicle.TRUTH, vehicle.MU_TRUTH])


def paper_reference(count: int = 64) -> Case:
    """The paper's vehicle with its reference signal, over all that bounds and order allow."""
    problem = vehicle.with_reference()
    signal = problem.experiments[0].data[0].signal
    bounds = problem.unknowns.lower[2:], problem.unknowns.upper[2:]
    collocated = Collocated(models.VEHICLE, bounds, (signal.knots, signal(signal.knots)))
    return Case(problem, PAPER, draw_anywhere(problem, count, seed=6), collocation=collocated)


def paper_positions(count: int = 64) -> Case:
    """The paper's vehicle from positions at 1 Hz with noise, over all that bounds and order allow."""
    times = np.arange(0.0, 15.5, 1.0)

    def build(values: np.ndarray) -> sf.Problem:
        data = sf.Measurements(times, values, observe=many.positions, sigma=SIGMA, names=("X", "Y"))
        run = sf.Experiment(data, vehicle.SEQUENCE, vehicle.START, *vehicle.HORIZON)
        return sf.Problem(skid_steer(), run, {"mu": sf.Parameter(vehicle.MU_START, lower=0.05, upper=2.0)})

    positions = sample_states(build(np.zeros((len(times), 2))), PAPER, times)[:, [0, 2]]
    problem = build(positions + np.random.default_rng(1).normal(0.0, SIGMA, positions.shape))
    collocated = Sampled(problem, _move_of_paper, observed=(0, 2), elements=2)
    return Case(problem, PAPER, draw_anywhere(problem, count, seed=5), noisy=True, collocation=collocated)


def _move_of_paper(mode: str, x: Sequence[Any], p: Sequence[Any], u: Sequence[Any], functions: Any) -> list[Any]:
    return models.VEHICLE.field(mode, x, p, functions)
