"""The general skid-steered vehicle against equations of constrained motion solved apart, and against the paper's."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from benchmarks.starts import vehicles
from switchfit.models import skid_steer
from switchfit.models.skid_steer import STUCK

MASS, LENGTH, WIDTH, GRAVITY = 80.0, 0.25, 0.23, 9.81
INERTIA = (4 * 2.5 * (12 * LENGTH**2 + 12 * WIDTH**2) + 70 * (0.89**2 + 0.55**2)) / 12


class Ground(NamedTuple):
    """Viscous and Coulomb's friction in front and behind, rolling resistance, slopes along X and Y."""

    viscous: tuple[float, float] = (0.8, 0.5)
    coulomb: tuple[float, float] = (0.3, 0.2)
    rolling: float = 0.02
    slope: tuple[float, float] = (0.03, -0.05)


GROUND = Ground()
NAMED = {
    "mu_front": "mf", "mu_rear": "mr", "coulomb_front": "kf", "coulomb_rear": "kr", "rolling": "rr", "slope_x": "sx",
    "slope_y": "sy",
}  # fmt: skip
VALUES = {"mf": 0.8, "mr": 0.5, "kf": 0.3, "kr": 0.2, "rr": 0.02, "sx": 0.03, "sy": -0.05}


def evaluate(function, x, p, *u):
    with jax.enable_x64(True):
        return np.asarray(
            function(0.0, jnp.asarray(x), {k: jnp.asarray(v) for k, v in p.items()}, *map(jnp.asarray, u))
        )


def constrained(mode, x, forces, ground, small=0.01):
    """dx/dt from M q'' = f + A' lambda, A q'' = -A' q' with q = (X, Y, theta), as one linear system."""
    _, dX, _, dY, theta, dtheta = x
    along, across = np.array([np.cos(theta), np.sin(theta)]), np.array([-np.sin(theta), np.cos(theta)])
    velocity = np.array([dX, dY])
    ahead = velocity @ along
    force = sum(forces) * along - (0.72 if mode == "stick" else 0.92) * velocity
    force = force - MASS * GRAVITY * (np.array(ground.slope) + ground.rolling * along * ahead / np.hypot(ahead, small))
    torque = WIDTH * (forces[0] - forces[1] - forces[2] + forces[3])
    for side, mu, k in zip((1, -1), ground.viscous, ground.coulomb, strict=True):
        if side not in STUCK[mode]:
            speed = across @ velocity + side * LENGTH * dtheta
            lateral = -MASS * GRAVITY / 2 * (mu * speed + k * speed / np.hypot(speed, small))
            force, torque = force + lateral * across, torque + side * LENGTH * lateral
    stuck = STUCK[mode]
    A = np.array([[*across, side * LENGTH] for side in stuck]).reshape(len(stuck), 3)
    turning = np.array([-dtheta * ahead for _ in stuck])
    system = np.block([[np.diag([MASS, MASS, INERTIA]), A.T], [A, np.zeros((len(stuck), len(stuck)))]])
    second = np.linalg.solve(system, np.concatenate([force, [torque], -turning]))[:3]
    return np.array([dX, second[0], dY, second[1], dtheta, second[2]])


def moving(random, mode):
    """A state in which the axles that stick do not move sideways."""
    theta, ahead, turn = random.uniform(-3, 3), random.uniform(-2, 2), random.normal()
    across = {"stick": 0.0, "front_slip": LENGTH * turn, "rear_slip": -LENGTH * turn, "slip": random.normal()}[mode]
    cos, sin = np.cos(theta), np.sin(theta)
    turn = 0.0 if mode == "stick" else turn
    return np.array([1.0, ahead * cos - across * sin, 2.0, ahead * sin + across * cos, theta, turn])


@pytest.mark.parametrize("mode", STUCK)
@pytest.mark.parametrize("ground", [GROUND, Ground(coulomb=(0, 0)), Ground(viscous=(0.7, 0.7), rolling=0.0)])
def test_each_mode_is_the_constrained_motion(mode, ground):
    system = skid_steer(modes=tuple(STUCK), restick="reset", forces_from_input=True, **NAMED)
    random = np.random.default_rng(0)
    keys = (*ground.viscous, *ground.coulomb, ground.rolling, *ground.slope)
    p = dict(zip(VALUES, map(float, keys), strict=True))
    for _ in range(10):
        x, forces = moving(random, mode), random.uniform(-20, 30, 4)
        expected = constrained(mode, x, forces, ground)
        np.testing.assert_allclose(evaluate(system.modes[mode], x, p, forces), expected, rtol=1e-12, atol=1e-13)


def test_numbers_and_names_are_the_same_vehicle():
    random = np.random.default_rng(1)
    numbers = {argument: VALUES[name] for argument, name in NAMED.items()}
    for mode in STUCK:
        x = moving(random, mode)
        named = skid_steer(modes=tuple(STUCK), restick="reset", **NAMED).modes[mode]
        fixed = skid_steer(modes=tuple(STUCK), restick="reset", **numbers).modes[mode]
        np.testing.assert_allclose(evaluate(named, x, VALUES), evaluate(fixed, x, {}), rtol=1e-14, atol=1e-15)


def of_paper(mode, x, mu):
    """Equation (18), term by term in its own order."""
    _, dX, _, dY, theta, dtheta = x
    m = 70.0 + 4 * 2.5
    inertia = 4 * 2.5 * (12 * 0.25**2 + 12 * 0.23**2) + 70.0 * (0.89**2 + 0.55**2)
    cos, sin = jnp.cos(theta), jnp.sin(theta)
    if mode == "stick":
        return jnp.stack([dX, (60.0 * cos - 0.72 * dX) / m, dY, (60.0 * sin - 0.72 * dY) / m, dtheta, 0.0 * dtheta])
    v = -sin * dX + cos * dY
    ddX = (54.0 * cos - 0.92 * dX) / m + 9.81 * mu * sin * v
    ddY = (54.0 * sin - 0.92 * dY) / m - 9.81 * mu * cos * v
    turning = 12 * 0.23 * (27.0 - 0.0 - 0.0 + 27.0)
    return jnp.stack([dX, ddX, dY, ddY, dtheta, (turning - 12 * 0.25**2 * 9.81 * m * mu * dtheta) / inertia])


@pytest.mark.parametrize("mode", ["stick", "slip"])
def test_the_papers_vehicle_is_the_special_case_bit_by_bit(mode):
    random = np.random.default_rng(2)
    field = skid_steer().modes[mode]
    for _ in range(50):
        x, mu = random.normal(size=6), random.uniform(0.1, 2.0)
        with jax.enable_x64(True):
            expected = np.asarray(of_paper(mode, jnp.asarray(x), jnp.asarray(mu)))
        np.testing.assert_array_equal(evaluate(field, x, {"mu": mu}), expected)


def test_impulses_stop_the_axles_and_lose_the_least_energy():
    system = skid_steer(modes=tuple(STUCK), restick="reset")
    random, metric = np.random.default_rng(3), np.diag([MASS, MASS, INERTIA])
    pairs = {(before, after) for before in STUCK for after in STUCK if not set(STUCK[after]) <= set(STUCK[before])}
    assert set(system.reset_maps) == pairs
    for (before, after), reset in system.reset_maps.items():
        x = moving(random, before)
        found = evaluate(reset, x, {"mu": 0.7})
        np.testing.assert_array_equal(found[[0, 2, 4]], x[[0, 2, 4]])
        across = np.array([-np.sin(x[4]), np.cos(x[4])])
        A = np.array([[*across, side * LENGTH] for side in STUCK[after]])
        # q'+ = (1 - M^-1 A' (A M^-1 A')^-1 A) q'-: a plastic impact
        inverse = np.linalg.inv(metric)
        projector = np.eye(3) - inverse @ A.T @ np.linalg.solve(A @ inverse @ A.T, A)
        np.testing.assert_allclose(found[[1, 3, 5]], projector @ x[[1, 3, 5]], rtol=1e-12, atol=1e-14)


def test_an_axle_that_sticks_stays_on_its_track():
    system = skid_steer(modes=("stick", "front_slip", "rear_slip", "slip"), restick="reset", mu_front=0.6, mu_rear=0.8)
    sequence = ("stick", "slip", "rear_slip", "front_slip", "stick")
    run = sf.Experiment(sf.RunningCost(lambda t, x, p: x @ x), sequence, (1.0, 2.0, 3.0, 4.0), 0.0, 5.0)
    path = sf.simulate(sf.Problem(system, run))
    _, dX, _, dY, theta, turn = path.states.T
    v = -np.sin(theta) * dX + np.cos(theta) * dY
    modes = np.array(path.modes)
    assert np.abs(turn).max() > 0.3
    for mode in sequence:
        inside = modes == mode
        for side in STUCK[mode]:
            assert np.abs((v + side * LENGTH * turn)[inside]).max() < 1e-8
    assert np.abs(v[modes == "slip"]).max() > 0.01


def test_two_turns_are_a_special_case():
    system = skid_steer(forces_from_input=True, restick="reset", mu_front="mu_f", mu_rear="mu_r", c_1="c")
    old = vehicles.two_turns_problem()
    new = sf.Problem(system, old.experiments, old.parameters)
    mine, theirs = (sf.evaluate(problem, vehicles.TWO_TURNS) for problem in (new, old))
    assert mine.cost == pytest.approx(theirs.cost, rel=1e-10)
    scale = np.sqrt(np.outer(np.diag(theirs.hessian), np.diag(theirs.hessian)))
    assert np.max(np.abs(mine.hessian - theirs.hessian) / scale) < 1e-8


def test_friction_and_slope_are_estimated():
    system = skid_steer(restick="reset", mu_front="front", mu_rear="rear", rolling="rolling", slope_x="uphill")
    truth = {"front": 0.8, "rear": 0.6, "rolling": 0.01, "uphill": 0.02}
    times = np.arange(0.5, 12.0, 0.5)

    def build(values, guess, tau):
        data = sf.Measurements(times, values, observe=lambda t, x, p: x[jnp.array([0, 2, 4])], sigma=0.01)
        run = sf.Experiment(data, ("stick", "slip", "stick"), tau, 0.0, 12.0)
        return sf.Problem(system, run, guess)

    path = sf.simulate(build(np.zeros((len(times), 3)), truth, (5.0, 9.0)))
    clean = path.states[np.searchsorted(path.times, times)][:, [0, 2, 4]]
    noisy = clean + np.random.default_rng(4).normal(0.0, 0.01, clean.shape)
    fit = sf.estimate(build(noisy, {name: 0.7 * value for name, value in truth.items()}, (4.7, 9.2)))
    assert fit.success
    assert np.all(np.abs(fit.theta - [5.0, 9.0, *truth.values()]) < 4 * fit.standard_errors)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (
            {"modes": ("stick", "drift")},
            ValueError,
            r"modes must be different ones of stick, front_slip, rear_slip, sl",
        ),
        ({"modes": ("stick", "stick")}, ValueError, r"got stick, stick"),
        ({"modes": ("stick", "rear_slip")}, ValueError, r"mode 'rear_slip', in which one axle sticks, needs restick="),
        ({"forces_from_input": True, "slip_forces": (1, 2, 3, 4)}, ValueError, r"slip_forces must be left out"),
        ({"m_b": -1.0}, ValueError, r"m_b must be positive; got -1.0"),
        ({"c_1": np.nan}, ValueError, r"c_1 must be finite; got nan"),
        ({"mu_front": "mu front"}, ValueError, r"mu_front must be a number or the name of a parameter; got the name"),
        ({"m_w": sf.Parameter(2.5)}, TypeError, r"m_w must be a number, or the name of a parameter to be fixed or est"),
        ({"small_speed": "v0"}, TypeError, r"small_speed must be a number; got 'v0'"),
    ],
)
def test_what_is_wrong_is_said(arguments, error, message):
    with pytest.raises(error, match=message):
        skid_steer(**arguments)
