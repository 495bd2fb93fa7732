"""Vehicles against equations of motion solved apart, closed forms and other integrators."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import switchfit as sf
from benchmarks import vehicle_coverage
from benchmarks.starts import vehicles
from switchfit.discretization.arguments import build_arguments
from switchfit.discretization.mesh import Mesh
from switchfit.engine.native.templates import Order, Sizes, Templates
from switchfit.fit.evaluator import Evaluator
from switchfit.models import (
    bicycle,
    differential_drive,
    lugre,
    magic_formula,
    rolling_body,
    skid_steer,
    sliding_block,
)
from switchfit.models.magic_formula import (
    ALIGNING_MOMENT,
    MAGIC_FORMULA,
    _curve,
    compute_aligning_moment,
    lateral_force,
    longitudinal_force,
)
from switchfit.models.skid_steer import STUCK
from switchfit.problem.functions import use_float64

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


@pytest.mark.slow
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
        ({"m_b": "70 kg"}, ValueError, r"m_b must be a number or the name of a parameter; got the name '70 kg'"),
        ({"m_b": np.array([70.0, 1.0])}, TypeError, r"m_b must be a number, or the name of a parameter .* got ndarray"),
        ({"m_w": -2.5}, ValueError, r"m_w must be 0 or more; got -2.5"),
        ({"coulomb_rear": -0.1}, ValueError, r"coulomb_rear must be 0 or more; got -0.1"),
        ({"modes": 3}, TypeError, r"modes must be a sequence of names out of stick, front_slip, .*; got 3"),
        ({"modes": [["stick"], "slip"]}, ValueError, r"modes must be different ones of .*; got \['stick'\], slip"),
        ({"modes": ()}, ValueError, r"modes must be different ones of .*; got none"),
        (
            {"stick_forces": (1, 2, 3)},
            ValueError,
            r"stick_forces must be four numbers \(N\), one for .*; got \(1, 2",
        ),
        ({"slip_forces": 15.0}, ValueError, r"slip_forces must be four numbers \(N\), one for each wheel; got 15.0"),
        ({"slip_forces": "1234"}, ValueError, r"slip_forces must be four numbers \(N\), one for each wheel; got '12"),
        ({"slip_forces": (1, 2, 3, np.nan)}, ValueError, r"slip_forces\[3\] must be finite; got nan"),
        ({"slip_forces": (1, 2, 3, "4 N")}, ValueError, r"slip_forces\[3\] must be a number; got '4 N'"),
        ({"forces_from_input": "no"}, TypeError, r"forces_from_input must be True or False; got 'no'"),
        ({"restick": "jump"}, ValueError, r"restick must be 'continuous' or 'reset'; got 'jump'"),
        ({"initial_state": [0.0] * 5}, ValueError, r"initial_state must have 6 entries, X, dX, .*; got 5"),
    ],
)
def test_what_is_wrong_is_said(arguments, error, message):
    with pytest.raises(error, match=message):
        skid_steer(**arguments)


# --- a bicycle that grips or slides -----------------------------------------------------------------------------------

CAR = {"m": 1500.0, "I_z": 2500.0, "a": 1.2, "b": 1.4, "C_f": 8e4, "C_r": 9e4, "mu": 0.6}


def force_on_axle(velocity, angle, slides, stiffness, load):
    """Force of an axle in the body's frame from its velocity there, by turning into the frame of the wheel and back."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    local = turn.T @ velocity
    if slides:
        return turn @ (-CAR["mu"] * load * local / np.linalg.norm(local))
    slip = angle - np.arctan2(velocity[1], velocity[0])
    return turn @ np.array([0.0, stiffness * slip])


@pytest.mark.parametrize("mode", ["grip", "front_slide", "rear_slide", "slide"])
def test_bicycle_is_newtons_law_for_a_rigid_body(mode):
    system = bicycle(modes=("grip", "front_slide", "rear_slide", "slide"))
    random = np.random.default_rng(0)
    a, b, m = CAR["a"], CAR["b"], CAR["m"]
    weight = m * GRAVITY
    for _ in range(10):
        theta, v_x, v_y, r = random.uniform([-3, 5, -2, -1], [3, 20, 2, 1])
        delta, drive = random.uniform(-0.5, 0.5), random.uniform(-500, 3000)
        front = force_on_axle(
            np.array([v_x, v_y + a * r]), delta, mode in ("front_slide", "slide"), CAR["C_f"], weight * b / (a + b)
        )
        rear = force_on_axle(
            np.array([v_x, v_y - b * r]), 0.0, mode in ("rear_slide", "slide"), CAR["C_r"], weight * a / (a + b)
        )
        force = front + rear + [drive, 0.0]
        torque = a * front[1] - b * rear[1]
        cos, sin = np.cos(theta), np.sin(theta)
        expected = [
            v_x * cos - v_y * sin, v_x * sin + v_y * cos, r, force[0] / m + r * v_y, force[1] / m - r * v_x,
            torque / CAR["I_z"],
        ]  # fmt: skip
        found = evaluate(system.modes[mode], np.array([1.0, 2.0, theta, v_x, v_y, r]), CAR, np.array([delta, drive]))
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_bicycle_corners_as_the_steady_state_says():
    """Yaw rate v delta / (L + K v²) with the understeer gradient K, for small angles (Pacejka, equation 1.60)."""
    system = bicycle(modes="grip")
    speed, delta = 15.0, 1e-4
    base, gradient = 2.6, CAR["m"] / 2.6 * (CAR["b"] / CAR["C_f"] - CAR["a"] / CAR["C_r"])

    def rates(v_y, r):
        found = evaluate(system.modes["grip"], np.array([0, 0, 0, speed, v_y, r]), CAR, np.array([delta, 0.0]))
        return found[4:]

    small = 1e-6
    slopes = np.stack([rates(small, 0.0) - rates(-small, 0.0), rates(0.0, small) - rates(0.0, -small)], axis=1)
    _, turn = np.linalg.solve(slopes / (2 * small), -rates(0.0, 0.0))
    assert turn == pytest.approx(speed * delta / (base + gradient * speed**2), rel=1e-6)


# --- a body that slides and rolls -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("mode", "v", "omega"), [("skid", 7.0, 0.0), ("spin", 0.5, 90.0), ("skid", 4.0, -20.0)])
def test_a_sliding_ball_rolls_when_and_as_fast_as_it_must(mode, v, omega):
    radius, mu, k = 0.11, 0.2, 0.4
    ball = rolling_body(radius=radius)
    slip = v - radius * omega
    when = abs(slip) / (mu * GRAVITY * (1 + 1 / k))
    times = np.linspace(0.05, 3.0, 60)
    nodes = sf.Measurements(times, np.zeros((60, 3)), sigma=1e-3)
    run = sf.Experiment(nodes, (mode, "roll"), (0.8 * when,), 0.0, 3.0)
    problem = sf.Problem(ball, run, {name: sf.Parameter(value, fixed=True) for name, value in
                                     {"mu": mu, "v_0": v, "omega_0": omega}.items()})  # fmt: skip
    fit = sf.estimate(problem, strategy="local")
    assert fit.transition_times[0][0] == pytest.approx(when, rel=1e-7)
    rolling = (v + k * radius * omega) / (1 + k)  # the moment about the ground stays
    last = sf.simulate(problem, fit.theta).states[-1]
    np.testing.assert_allclose(last[1:], [rolling, rolling / radius], rtol=1e-6)


def test_friction_and_start_of_a_ball_follow_from_its_path():
    ball = rolling_body(radius=0.11, slope=0.03, rolling=0.01)
    truth = {"mu": 0.2, "v_0": 6.0, "omega_0": 0.0}
    cos, sin = np.cos(0.03), np.sin(0.03)
    when = 6.0 / (GRAVITY * (0.2 * cos * 3.5 + sin))
    times = np.linspace(0.02, 2.0, 100)

    def build(values, guess, tau):
        data = sf.Measurements(times, values, observe=lambda t, x, p: x[0], sigma=0.005)
        return sf.Problem(ball, sf.Experiment(data, ("skid", "roll"), (tau,), 0.0, 2.0), guess)

    free = {"mu": 0.2, "v_0": 6.0, "omega_0": sf.Parameter(0.0, fixed=True)}
    path = sf.simulate(build(np.zeros(100), truth, when), np.array([when, *truth.values()]))
    clean = path.states[np.searchsorted(path.times, times), 0]
    noisy = clean + np.random.default_rng(0).normal(0, 0.005, 100)
    fit = sf.estimate(build(noisy, free | {"mu": 0.3, "v_0": 5.0}, 0.5))
    assert fit.success
    assert np.all(np.abs(fit.theta - [when, 0.2, 6.0]) < 4 * fit.standard_errors)


# --- LuGre friction ---------------------------------------------------------------------------------------------------

BRISTLES = {"sigma_0": 1e5, "sigma_1": np.sqrt(1e5), "sigma_2": 0.4, "F_c": 1.0, "F_s": 1.5, "v_s": 0.001}
"""Table I of Canudas de Wit and others (1995)."""


def test_lugre_slides_steadily_on_the_stribeck_curve():
    system = lugre()
    for v in (1e-4, 5e-4, 2e-3, 0.1):
        level = 1.0 + 0.5 * np.exp(-((v / 0.001) ** 2))
        for mode, sign in (("forward", 1), ("backward", -1)):
            z, force = sign * level / 1e5, sign * level + 0.4 * sign * v
            rate = evaluate(system.modes[mode], np.array([0.0, sign * v, z]), BRISTLES, np.array(force))
            np.testing.assert_allclose(rate, [sign * v, 0.0, 0.0], atol=1e-9)


def test_lugre_sticks_and_slips_on_a_spring_as_published():
    """An experiment of the paper: m = 1 kg, k = 2 N/m, pulled at 0.1 m/s; against LSODA with |v| in one function."""
    system = lugre(k=2.0)

    def move(t, x):
        position, v, z = x
        level = 1.0 + 0.5 * np.exp(-((v / 0.001) ** 2))
        dz = v - 1e5 * abs(v) * z / level
        return [v, 2.0 * (0.1 * t - position) - 1e5 * z - np.sqrt(1e5) * dz - 0.4 * v, dz]

    path = scipy.integrate.solve_ivp(move, (0.0, 20.0), [0.0] * 3, method="LSODA", rtol=1e-9, atol=1e-12)
    states = path.y.T[:: max(1, len(path.t) // 200)]
    times = path.t[:: max(1, len(path.t) // 200)]
    for t, x in zip(times, states, strict=True):
        mode = "forward" if x[1] >= 0 else "backward"
        found = evaluate(system.modes[mode], x, BRISTLES, np.array(0.1 * t))
        np.testing.assert_allclose(found, move(t, x), rtol=1e-9, atol=1e-9)
    moving = path.y[1] > 0.01
    assert 2 <= np.count_nonzero(np.diff(moving.astype(int)) == 1) <= 4  # it sticks for long, and slips at once
    assert 0.7 < path.y[0].max() < 2.0


@pytest.mark.slow
def test_stiff_bristles_are_fitted_with_implicit_steps():
    """With the published stiffness, from a guess that is near: a body that sticks and slips does so at other times."""
    case = vehicle_coverage.CASES["lugre, spring"]()
    system = lugre(k=2.0, sigma_0=1e5, sigma_1=np.sqrt(1e5), v_s=0.001)
    problem = sf.Problem(system, case.problem.experiments, case.problem.parameters)
    stiff = vehicle_coverage.Case(problem, case.truth)
    fit = sf.estimate(vehicle_coverage.draw_log(stiff, [0, 0]), strategy="local", start=[0.41, 0.999, 1.499])
    assert "forward" in fit.engine.implicit_modes
    assert fit.verdict.level == "good"
    assert np.all(np.abs(fit.theta - stiff.theta) < 4 * fit.standard_errors)


# --- wheel speeds -----------------------------------------------------------------------------------------------------


def test_differential_drive_turns_about_its_centers_of_rotation():
    """The point of the body at (x_v, y_l) moves as the left tread, (V_l, 0), and that at y_r as the right one."""
    system = differential_drive(radius=0.16, alpha_l="al", alpha_r="ar")
    p = {"y_l": 0.9, "y_r": -0.7, "x_v": -0.1, "al": 0.95, "ar": 0.9}
    theta, w = 0.4, np.array([5.0, 9.0])
    dX, dY, turn = evaluate(system.modes["slip"], np.array([1.0, 2.0, theta]), p, w)
    v = np.array([[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]]) @ [dX, dY]
    for y, alpha, speed in ((0.9, 0.95, 5.0), (-0.7, 0.9, 9.0)):
        point = np.array([-0.1, y])
        np.testing.assert_allclose(v + turn * np.array([-point[1], point[0]]), [alpha * 0.16 * speed, 0.0], atol=1e-14)
    ideal = evaluate(system.modes["grip"], np.array([1.0, 2.0, 0.0]), {}, w)
    np.testing.assert_allclose(ideal, [0.16 * 7.0, 0.0, 0.16 * 4.0 / 0.57], rtol=1e-14)


def test_wheels_that_are_dragged_sideways_lose_speed_forward():
    """The yaw rate stays; a side that stands loses the whole share, half its speed a third of it, straight nothing."""
    p = {"y_l": 0.9, "y_r": -0.9, "x_v": -0.1, "loss": 0.6}
    x = np.zeros(3)
    slip, plain = (differential_drive(turn_slip=loss).modes["slip"] for loss in ("loss", 0.0))
    for w, kept in (
        ((0.0, 40.0), 0.4),
        ((-40.0, 40.0), 0.4),
        ((20.0, 40.0), 0.8),
        ((-20.0, -40.0), 0.8),
        ((40.0, 40.0), 1.0),
    ):
        with_loss, without = (evaluate(mode, x, p, np.array(w, dtype=float)) for mode in (slip, plain))
        np.testing.assert_allclose(with_loss, without * [kept, 1.0, 1.0], rtol=0, atol=2e-2)
        np.testing.assert_array_equal(with_loss[1:], without[1:])
    assert evaluate(slip, x, p, np.zeros(2)) == pytest.approx([0.0, 0.0, 0.0])
    grip = differential_drive(turn_slip="loss").modes["grip"]
    np.testing.assert_allclose(evaluate(grip, x, {}, np.array([5.0, 9.0]))[0], 0.165 * 7.0, rtol=1e-14)


@pytest.mark.slow
def test_turn_slip_is_found_from_its_own_simulation():
    """With intervals that contain the truth, and derivatives that agree with differences."""
    system = differential_drive(turn_slip="turn_slip")
    truth = {"y_l": 0.9, "y_r": -0.8, "x_v": -0.1, "turn_slip": 0.5}
    times, random = np.linspace(0.1, 4.0, 40), np.random.default_rng(1)
    wheels = [np.array([[2.0, 6.0], [5.0, 5.0]]), np.array([[5.0, -2.0], [0.5, -4.0]])]

    def build(values, guess):
        runs = [
            sf.Experiment(sf.Measurements(times, y, sigma=0.01), ("slip",), t0=0.0, tf=4.0, inputs=sf.Input([0, 2], w))
            for y, w in zip(values, wheels, strict=True)
        ]
        return sf.Problem(system, runs, guess)

    clean = build([np.zeros((40, 3))] * 2, truth)
    theta = np.array(list(truth.values()))
    paths = [sf.simulate(clean, theta, experiment=e) for e in range(2)]
    seen = [path.states[np.searchsorted(path.times, times)] for path in paths]
    problem = build([y + random.normal(0.0, 0.01, y.shape) for y in seen], truth | {"turn_slip": 0.1, "y_l": 0.5})
    assert sf.check_derivatives(problem).passed
    fit = sf.estimate(problem)
    assert fit.success
    assert np.all(np.abs(fit.theta - theta) < 3 * fit.standard_errors)
    assert fit.standard_errors[3] < 0.01


def test_delay_and_lag_of_commands_are_shared_by_all_steps():
    system = differential_drive(modes="slip", speeds="commanded", delay="delay", x_v=0.0)
    truth = {"delay": 0.35, "y_l": 0.8, "y_r": -0.9, "lag": 0.2}
    times = np.linspace(0.1, 4.0, 40)
    random = np.random.default_rng(0)
    commands = [(4.0, 8.0), (6.0, 3.0), (-3.0, 5.0)]

    def build(values, guess):
        runs = [
            sf.Experiment(
                sf.Measurements(times, y, observe=lambda t, x, p: x[:3], sigma=0.01),
                ("wait", "slip"), (0.3,), 0.0, 4.0,
                inputs=sf.Input([0.0, 4.0], [command, command]), name=f"step{k}",
            )
            for k, (y, command) in enumerate(zip(values, commands, strict=True))
        ]  # fmt: skip
        return sf.Problem(system, runs, guess)

    zeros = [np.zeros((40, 3))] * 3
    clean = build(zeros, truth)
    theta = np.array([0.35] * 3 + list(truth.values()))
    values = []
    for e, command in enumerate(commands):
        path = sf.simulate(clean, theta, experiment=e)
        seen = path.states[np.searchsorted(path.times, times), :3]
        turn = 0.165 * (command[1] - command[0]) / 1.7
        late = np.maximum(times - 0.35, 0.0)
        np.testing.assert_allclose(seen[:, 2], turn * (late - 0.2 * (1 - np.exp(-late / 0.2))), atol=1e-8)
        values.append(seen + random.normal(0.0, 0.01, seen.shape))
    fit = sf.estimate(build(values, {"delay": 0.2, "y_l": 0.5, "y_r": -0.5, "lag": 0.1}))
    assert fit.success
    np.testing.assert_allclose(np.ravel(fit.transition_times), fit.parameters["delay"], atol=1e-9)
    found = np.array([fit.parameters[name] for name in truth])
    assert np.all(np.abs(found - list(truth.values())) < 4 * fit.standard_errors[-4:])
    assert Evaluator(build(values, truth), theta).engines[0].engine.name == "native"


# --- the Magic Formula ------------------------------------------------------------------------------------------------


def test_aligning_moment_against_a_value_worked_out_apart():
    """With the coefficients of Bakker, Nyborg and Pacejka (1987): 3 degrees at 4 kN."""
    assert float(compute_aligning_moment(3.0, 4.0, ALIGNING_MOMENT)) == pytest.approx(-52.605, abs=5e-4)


def test_derivatives_of_the_curve_in_closed_form_are_those_of_its_operations():
    def plain(z):
        return jnp.sin(1.65 * jnp.arctan(z[0] + z[1] * (jnp.arctan(z[0]) - z[0])))

    def closed(z):
        return _curve(z[0], z[1], 1.65)

    orders = (lambda f: f, jax.grad, jax.hessian, lambda f: jax.jacfwd(jax.hessian(f)))
    evaluate = jax.jit(lambda z: [(derive(closed)(z), derive(plain)(z)) for derive in orders])
    with jax.enable_x64(True):
        for point in ([0.7, -0.4], [-3.0, 0.9], [1e-3, -2.0]):
            for found, expected in evaluate(jnp.array(point)):
                np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("settings", [{}, {"aligning": True}])
def test_tyres_run_in_machine_code(settings):
    """With all sixteen coefficients of the forces unknown; with those of the moment, where they are fixed."""
    free = dict(MAGIC_FORMULA) if not settings else {name: MAGIC_FORMULA[name] for name in ("a_x2", "a_y2", "a_x4")}
    held = {name: sf.Parameter(value, fixed=True) for name, value in {**MAGIC_FORMULA, **ALIGNING_MOMENT}.items()}
    run = vehicle_coverage.CASES["magic_formula"]().problem.experiments[0]
    used = held if settings else MAGIC_FORMULA
    problem = sf.Problem(magic_formula(**settings), run, {name: (held | free)[name] for name in used})
    structure, arguments = (
        problem.structures[0],
        build_arguments(problem, 0, Mesh.from_times(np.linspace(0.0, 3.0, 61))),
    )
    with use_float64():
        Templates(structure, Sizes.of(structure, arguments), Order.HESSIAN).stage(0)  # raises if it is too long


def turn_on_tyres(x, treads, **settings):
    drive = magic_formula(wheel_radius=0.2, **settings).modes["drive"]
    p = dict(MAGIC_FORMULA) | dict(ALIGNING_MOMENT)
    return evaluate(drive, np.array(x), p, np.array(treads) / 0.2)[[1, 3, 5, *range(6, len(x))]]


def test_loads_balance_the_moments_of_the_accelerations():
    height, x, treads = 0.2, [0.0, 3.0, 0.0, 0.3, 0.0, 0.2], np.array([3.4, 2.9, 3.0, 3.6])
    along, across = 1.3, -6.5
    found = turn_on_tyres([*x, along, across], treads, height=height)
    ahead, left = np.array([1, 1, -1, -1]) * LENGTH, np.array([-1, 1, 1, -1]) * WIDTH
    loads = 1e-3 * MASS / 4 * (GRAVITY - height * (along * ahead / LENGTH**2 + across * left / WIDTH**2))
    assert loads.sum() == pytest.approx(1e-3 * MASS * GRAVITY)
    assert 1e3 * (loads @ ahead) == pytest.approx(-MASS * height * along)
    assert 1e3 * (loads @ left) == pytest.approx(-MASS * height * across)
    V_x, V_y = 3.0 - left * 0.2, 0.3 + ahead * 0.2
    V = np.sqrt(0.5 * (V_x**2 + treads**2) + 0.1**2)
    s_x, s_y = (treads - V_x) / V, -V_y / V
    s = np.sqrt(s_x**2 + s_y**2 + 1e-6)
    F_x = np.array([longitudinal_force(100 * s[i], loads[i], MAGIC_FORMULA) for i in range(4)]) * s_x / s
    F_y = np.array([lateral_force(np.degrees(np.arctan(s[i])), loads[i], MAGIC_FORMULA) for i in range(4)]) * s_y / s
    inertia = 70 * (0.89**2 + 0.55**2) / 12 + 10 * (LENGTH**2 + WIDTH**2)
    forces = np.array([F_x.sum(), F_y.sum()]) / MASS
    expected = [*forces, (ahead @ F_y - left @ F_x) / inertia, *(forces - [along, across]) / 0.05]
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert np.abs(turn_on_tyres(x, treads)[2] - found[2]) > 1e-2  # loads matter


def test_aligning_moments_turn_the_body_into_its_velocity():
    V, angle, load = 4.0, np.radians(3.0), 1e-3 * GRAVITY * MASS / 4
    x = [0.0, V, 0.0, V * np.tan(angle), 0.0, 0.0]
    without, with_moment = (turn_on_tyres(x, [V] * 4, low_speed=1e-6, aligning=a) for a in (False, True))
    np.testing.assert_array_equal(without[:2], with_moment[:2])
    inertia = 70 * (0.89**2 + 0.55**2) / 12 + 10 * (LENGTH**2 + WIDTH**2)
    expected = -4 * float(compute_aligning_moment(3.0, load, ALIGNING_MOMENT)) / inertia
    assert with_moment[2] - without[2] == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize(
    ("make", "arguments", "error", "message"),
    [
        (bicycle, {"modes": "drift"}, ValueError, r"modes must be different ones of grip, front_slide"),
        (bicycle, {"m": 0.0}, ValueError, r"m must be positive; got 0.0"),
        (rolling_body, {"radius": None}, TypeError, r"radius must be a number, or the name of a parameter"),
        (lugre, {"F_c": -1}, ValueError, r"F_c must be positive; got -1"),
        (differential_drive, {"modes": "wait"}, ValueError, r"modes must be different ones of grip, slip; got wait"),
        (
            differential_drive,
            {"modes": None},
            TypeError,
            r"modes must be a sequence of names out of grip, slip; got N",
        ),
        (differential_drive, {"radius": "0.16 m"}, ValueError, r"radius must be a number or the name of a parameter"),
        (differential_drive, {"track": [0.5, 0.6]}, TypeError, r"track must be a number, or the name .* got list"),
        (differential_drive, {"track": -0.5}, ValueError, r"track must be positive; got -0.5"),
        (differential_drive, {"speeds": "commanded", "delay": -1.0}, ValueError, r"delay must be 0 or more; got -1.0"),
        (
            differential_drive,
            {"y_l": 0.4, "y_r": 0.4},
            ValueError,
            r"y_l, on the left, must be larger than y_r; got 0",
        ),
        (differential_drive, {"turn_slip": 2.0}, ValueError, r"turn_slip must be from 0 to 1; got 2.0"),
        (
            differential_drive,
            {"speeds": "commanded", "initial_state": [0, 0, 0]},
            ValueError,
            r"initial_state must have 5 entries, X, Y, theta, w_l, w_r; got 3",
        ),
        (bicycle, {"C_f": -1.0}, ValueError, r"C_f must be 0 or more; got -1.0"),
        (bicycle, {"initial_state": [0.0] * 6}, ValueError, r"initial_state must have a positive v_x, .*; got 0.0"),
        (bicycle, {"initial_state": [0.0] * 3}, ValueError, r"initial_state must have 6 entries, X, Y, theta, v_x"),
        (rolling_body, {"mu": -0.2}, ValueError, r"mu must be 0 or more; got -0.2"),
        (lugre, {"sigma_1": -1}, ValueError, r"sigma_1 must be 0 or more; got -1"),
        (lugre, {"initial_state": [0.0]}, ValueError, r"initial_state must have 3 entries, x, v, z; got 1"),
        (sliding_block, {"g": "g"}, TypeError, r"g must be a number; got 'g'"),
        (magic_formula, {"wheel_radius": "0.1"}, TypeError, r"wheel_radius must be a number; got '0.1'"),
        (magic_formula, {"m_b": -1.0}, ValueError, r"m_b must be positive; got -1.0"),
        (magic_formula, {"aligning": "yes"}, TypeError, r"aligning must be True or False; got 'yes'"),
        (magic_formula, {"initial_state": (0, 1)}, ValueError, r"initial_state must have 6 entries, X, dX"),
        (differential_drive, {"speeds": "wheels"}, ValueError, r"speeds must be 'measured' or 'commanded'; got 'wh"),
        (differential_drive, {"delay": 0.1}, ValueError, r"delay is that of commanded speeds; got speeds='measured'"),
        (magic_formula, {"height": -0.1}, ValueError, r"height must be 0 or more; got -0.1"),
    ],
)
def test_what_is_wrong_with_other_vehicles_is_said(make, arguments, error, message):
    with pytest.raises(error, match=message):
        make(**arguments)


@pytest.mark.parametrize(
    ("system", "mode", "channels", "message"),
    [
        (skid_steer(forces_from_input=True), "slip", 3, r"must have 4 channels, F1, F2, F3, F4 \(N\); it has 3"),
        (skid_steer(forces_from_input=True), "stick", 5, r"must have 4 channels, F1, F2, F3, F4 \(N\); it has 5"),
        (differential_drive(), "grip", 4, r"must have 2 channels, w_l, w_r \(rad/s\); it has 4"),
        (bicycle(), "grip", 1, r"must have 2 channels, delta \(rad\), F_x \(N\); it has 1"),
        (magic_formula(), "drive", 2, r"must have 4 channels, w1, w2, w3, w4 \(rad/s\); it has 2"),
        (lugre(), "forward", 2, r"must have one channel, force or position; it has 2"),
    ],
)
def test_an_input_with_other_channels_is_refused(system, mode, channels, message):
    """JAX takes the last channel for those that are missing: three forces would be four."""
    data = sf.Measurements([0.5], np.zeros((1, 1)), observe=lambda t, x, p: x[:1])
    values = np.ones(2) if channels == 1 else np.ones((2, channels))
    run = sf.Experiment(data, (mode,), (), 0.0, 1.0, inputs=sf.Input([0.0, 1.0], values))
    needed = (*BRISTLES, *CAR, *MAGIC_FORMULA, "y_l", "y_r", "x_v")
    with pytest.raises(ValueError, match=rf"mode '{mode}'.*{message}"):
        sf.evaluate(sf.Problem(system, run, dict.fromkeys(needed, 1.0)))


# --- derivatives, and intervals that hold the truth -------------------------------------------------------------------


SLOW_TO_CHECK = (
    "lugre, spring",
    "magic_formula",
    "magic_formula, loads",
    "skid_steer, front_slip",
    "skid_steer, slope and mass",
    "differential_drive, measured",
)
"""Cases that take long to compile, or that differ little from another."""


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW_TO_CHECK)) for name in vehicle_coverage.CASES],
)
def test_derivatives_of_each_model_are_right(name):
    """In machine code, without the paper's equations, which take JAX seconds to compile: the study does that."""
    case = vehicle_coverage.CASES[name]()
    check = sf.check_derivatives(vehicle_coverage.draw_log(case), paper=False)
    assert check.passed, check
    assert np.isfinite(check.observed_orders[0])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["differential_drive, measured", "bicycle"])
def test_intervals_hold_the_truth(name):
    """Of 40 fits, at least 34 in each unknown: binomial with 95 %, fewer with a probability of 0.3 %."""
    found = vehicle_coverage.measure_coverage(vehicle_coverage.CASES[name](), 40)
    assert np.all(found.intervals * 40 > 33.5), found
    assert found.good > 0.95
    assert found.far == 0


@pytest.mark.slow
def test_a_log_of_a_study_is_drawn_again():
    """What is fitted again by `switchfit.estimate` is the log that the study could not fit."""
    case = vehicle_coverage.turn_as_in_the_paper()
    study = sf.monte_carlo(case.problem, 2, theta=case.theta, start=case.problem.initial_theta)
    fit = sf.estimate(vehicle_coverage.draw_log(case, [0, 1]))
    np.testing.assert_allclose(fit.theta, study.theta[1], atol=1e-5)


@pytest.mark.slow
def test_derivatives_are_checked_on_a_mesh_for_the_given_theta():
    """The mesh of the first guess, 1 s away, leaves gaps of 3e-3 between the paper's equations and the cost's."""
    case = vehicle_coverage.turn_as_in_the_paper()
    check = sf.check_derivatives(vehicle_coverage.draw_log(case), case.theta)
    assert check.passed, check
    assert max(check.gradient_gap, check.hessian_gap) < 1e-5
