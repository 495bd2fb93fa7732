"""Vehicles against equations of motion solved apart, closed forms and other integrators."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import switchfit as sf
from benchmarks import vehicle_coverage
from support.models import refused
from switchfit.meshes.evaluator import Evaluator
from switchfit.models import bicycle, differential_drive, lugre, magic_formula, skid_steer, sliding_block
from switchfit.models.tyre_forces import (
    ALIGNING_MOMENT,
    MAGIC_FORMULA,
    _curve,
    compute_aligning_moment,
    lateral_force,
    longitudinal_force,
)

MASS, LENGTH, WIDTH, GRAVITY = 80.0, 0.25, 0.23, 9.81
INERTIA = 70 * (0.89**2 + 0.55**2) / 12 + 10 * (LENGTH**2 + WIDTH**2)


def evaluate(function, x, p, *u):
    with jax.enable_x64(True):
        given = {k: jnp.asarray(v) for k, v in p.items()}
        return np.asarray(function(0.0, jnp.asarray(x), given, *map(jnp.asarray, u)))


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


def test_every_constant_matters():
    x = np.array([0.1, 2.0, 0.2, 1.0, 0.6, 0.3])
    base = {mode: evaluate(f, x, {"mu": 0.7}) for mode, f in skid_steer().modes.items()}
    for name in ("m_b", "m_w", "B_l", "B_w", "a", "b", "c_1", "c_2", "g"):
        changed = {mode: evaluate(f, x, {"mu": 0.7}) for mode, f in skid_steer(**{name: 1.3}).modes.items()}
        assert any(not np.allclose(base[mode], changed[mode], rtol=1e-6) for mode in base), name


def test_wheel_forces_by_mode():
    forces = {"stick_forces": (1, 2, 3, 4), "slip_forces": (5, 1, 2, 4)}
    for mode, ahead, turn in (("stick", 10, 0), ("slip", 12, 6), ("rear_slip", 12, 6)):
        field = skid_steer(modes=("stick", mode) if turn else ("stick",), restick="reset", **forces).modes[mode]
        rate = evaluate(field, np.zeros(6), {"mu": 0.7})
        assert rate[1] == pytest.approx(ahead / 80)
        assert (rate[5] != 0) == (turn != 0)


# --- a block that slides ----------------------------------------------------------------------------------------------

BLOCK = {"mu": 0.2, "x0": 1.0, "y0": 2.0, "vx0": 3.0, "vy0": -4.0}


def test_sliding_block_decelerates_along_its_first_velocity():
    """And is smooth where it would stop."""
    system = sliding_block()
    np.testing.assert_array_equal(system.initial_state(BLOCK), [1, 2, 3, -4])
    rate = evaluate(system.modes["slide"], [1.0, 2.0, 3.0, -4.0], BLOCK)
    np.testing.assert_allclose(rate, [3, -4, -0.2 * 9.81 * 0.6, 0.2 * 9.81 * 0.8], rtol=1e-14)
    moon = evaluate(sliding_block(g=1.0).modes["slide"], [1.0, 2.0, 3.0, -4.0], BLOCK)
    np.testing.assert_allclose(moon[2:], [-0.12, 0.16])
    at_rest = jax.jacfwd(lambda t, x, p: system.modes["slide"](t, x, p), argnums=1)
    np.testing.assert_array_equal(evaluate(at_rest, [1.0, 2.0, 0.0, 0.0], BLOCK), np.eye(4, k=2))
    np.testing.assert_array_equal(evaluate(system.modes["stick"], [1.0, 2.0, 0.1, 0.0], BLOCK), np.zeros(4))


# --- LuGre friction ---------------------------------------------------------------------------------------------------

BRISTLES = {"sigma_0": 1e5, "sigma_1": np.sqrt(1e5), "sigma_2": 0.4, "F_c": 1.0, "F_s": 1.5, "v_s": 0.001}
"""Table I of Canudas de Wit and others (1995)."""


def test_lugre_sticks_and_slips_on_a_spring_as_published():
    """An experiment of the paper: m = 1 kg, k = 2 N/m, pulled at 0.1 m/s; against LSODA with |v| in one function."""
    system = lugre(k=2.0)

    def move(t, x):
        position, v, z = x
        level = 1.0 + 0.5 * np.exp(-((v / 0.001) ** 2))
        dz = v - 1e5 * abs(v) * z / level
        return [v, 2.0 * (0.1 * t - position) - 1e5 * z - np.sqrt(1e5) * dz - 0.4 * v, dz]

    path = scipy.integrate.solve_ivp(move, (0.0, 20.0), [0.0] * 3, method="LSODA", rtol=1e-9, atol=1e-12)
    each = max(1, len(path.t) // 200)
    for t, x in zip(path.t[::each], path.y.T[::each], strict=True):
        mode = "forward" if x[1] >= 0 else "backward"
        found = evaluate(system.modes[mode], x, BRISTLES, np.array(0.1 * t))
        np.testing.assert_allclose(found, move(t, x), rtol=1e-9, atol=1e-9)


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


@pytest.mark.parametrize(
    ("w", "kept"),
    [((0.0, 40.0), 0.4), ((-40.0, 40.0), 0.4), ((20.0, 40.0), 0.8), ((-20.0, -40.0), 0.8), ((0.3, 0.3), 1.0)],
)
def test_wheels_that_are_dragged_sideways_lose_speed_forward(w, kept):
    """The yaw rate stays; a side that stands loses the whole share, half its speed a third of it, straight nothing."""
    p, x = {"y_l": 0.9, "y_r": -0.9, "x_v": -0.1, "loss": 0.6}, np.zeros(3)
    slip, plain = (differential_drive(turn_slip=loss).modes["slip"] for loss in ("loss", 0.0))
    with_loss, without = (evaluate(mode, x, p, np.array(w)) for mode in (slip, plain))
    np.testing.assert_allclose(with_loss, without * [kept, 1.0, 1.0], rtol=0, atol=2e-3)
    assert evaluate(slip, x, p, np.zeros(2)) == pytest.approx([0.0, 0.0, 0.0])
    grip = differential_drive(turn_slip="loss").modes["grip"]
    np.testing.assert_allclose(evaluate(grip, x, {}, np.array(w))[0], 0.0825 * sum(w), rtol=1e-14)


def test_delay_and_lag_of_commands_are_shared_by_all_steps():
    """Headings are those of the closed form, and a fit of a disturbed guess finds what all of them have in common."""
    system = differential_drive(modes="slip", speeds="commanded", delay="delay", x_v=0.0)
    truth = {"delay": 0.35, "y_l": 0.8, "y_r": -0.9, "lag": 0.2}
    times, runs = np.linspace(0.1, 4.0, 40), []
    for command in ((4.0, 8.0), (6.0, 3.0), (-3.0, 5.0)):
        data = sf.Measurements(times, np.zeros((40, 3)), observe=lambda t, x, p: x[:3], sigma=0.01)
        inputs = sf.Input([0.0, 4.0], [command, command])
        run = sf.Experiment(data, ("wait", "slip"), (0.3,), 0.0, 4.0, inputs=inputs)
        path = sf.simulate(sf.Problem(system, run, truth), [0.35, *truth.values()])
        seen = path.states[np.searchsorted(path.times, times), :3]
        late = np.maximum(times - 0.35, 0.0)
        turn = 0.165 * (command[1] - command[0]) / 1.7
        np.testing.assert_allclose(seen[:, 2], turn * (late - 0.2 * (1 - np.exp(-late / 0.2))), atol=1e-8)
        runs.append(replace(run, data=replace(data, values=seen)))
    fit = sf.estimate(sf.Problem(system, runs, {"delay": 0.2, "y_l": 0.5, "y_r": -0.5, "lag": 0.1}))
    np.testing.assert_allclose(np.ravel(fit.transition_times), 0.35, atol=1e-6)
    np.testing.assert_allclose([fit.parameters[name] for name in truth], list(truth.values()), rtol=1e-5)


# --- the Magic Formula ------------------------------------------------------------------------------------------------


def test_magic_formula_against_values_worked_out_apart():
    """Coefficients of Bakker, Nyborg and Pacejka (1987): lateral at 5 degrees, longitudinal at 10 %, 2 to 8 kN."""
    lateral = [float(lateral_force(5.0, load, MAGIC_FORMULA)) for load in (2, 4, 6, 8)]
    longitudinal = [float(longitudinal_force(10.0, load, MAGIC_FORMULA)) for load in (2, 4, 6, 8)]
    np.testing.assert_allclose(lateral, [1828.90, 3389.60, 4409.00, 4821.91], rtol=0, atol=0.006)
    np.testing.assert_allclose(longitudinal, [2191.82, 4234.44, 6090.57, 7736.34], rtol=0, atol=0.006)
    assert float(compute_aligning_moment(3.0, 4.0, ALIGNING_MOMENT)) == pytest.approx(-52.605, abs=5e-4)


def test_forces_of_tyres_turn_with_the_vehicle_and_are_smooth_and_bounded_at_standstill():
    turn = 0.7
    c, s = np.cos(turn), np.sin(turn)
    along, across, yaw = turn_on_tyres([0.0, 3.0, 0.0, 0.4, 0.0, 0.2], [3.5, 3.0, 2.0, 4.0])
    turned = turn_on_tyres([0.0, 3 * c - 0.4 * s, 0.0, 3 * s + 0.4 * c, turn, 0.2], [3.5, 3.0, 2.0, 4.0])
    np.testing.assert_allclose(turned, [c * along - s * across, s * along + c * across, yaw], rtol=1e-12)
    np.testing.assert_array_equal(turn_on_tyres([0.0] * 6, [0.0] * 4), 0.0)
    assert 0 < turn_on_tyres([0.0] * 6, [20.0] * 4)[0] < 1.2 * 9.81


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
    assert 1e3 * (loads @ ahead) == pytest.approx(-MASS * height * along)
    assert 1e3 * (loads @ left) == pytest.approx(-MASS * height * across)
    V_x, V_y = 3.0 - left * 0.2, 0.3 + ahead * 0.2
    V = np.sqrt(0.5 * (V_x**2 + treads**2) + 0.1**2)
    s_x, s_y = (treads - V_x) / V, -V_y / V
    s = np.sqrt(s_x**2 + s_y**2 + 1e-6)
    F_x = np.array([longitudinal_force(100 * s[i], loads[i], MAGIC_FORMULA) for i in range(4)]) * s_x / s
    F_y = np.array([lateral_force(np.degrees(np.arctan(s[i])), loads[i], MAGIC_FORMULA) for i in range(4)]) * s_y / s
    forces = np.array([F_x.sum(), F_y.sum()]) / MASS
    expected = [*forces, (ahead @ F_y - left @ F_x) / INERTIA, *(forces - [along, across]) / 0.05]
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_aligning_moments_turn_the_body_into_its_velocity():
    V, angle, load = 4.0, np.radians(3.0), 1e-3 * GRAVITY * MASS / 4
    x = [0.0, V, 0.0, V * np.tan(angle), 0.0, 0.0]
    without, with_moment = (turn_on_tyres(x, [V] * 4, low_speed=1e-6, aligning=a) for a in (False, True))
    np.testing.assert_array_equal(without[:2], with_moment[:2])
    expected = -4 * float(compute_aligning_moment(3.0, load, ALIGNING_MOMENT)) / INERTIA
    assert with_moment[2] - without[2] == pytest.approx(expected, rel=2e-3)


test_what_is_wrong_is_said = refused(
    ((skid_steer, {"modes": ("stick", "drift")}), "modes must be different ones of stick, front_slip, re"),
    ((skid_steer, {"modes": ()}), "rear_slip, slip; got none"),
    ((skid_steer, {"modes": ("stick", "rear_slip")}), "'rear_slip', in which one axle sticks, needs restick="),
    ((skid_steer, {"forces_from_input": True, "slip_forces": (1, 2, 3, 4)}), "slip_forces must be left out"),
    ((skid_steer, {"forces_from_input": "no"}), "forces_from_input must be True or False; got 'no'"),
    ((skid_steer, {"stick_forces": (1, 2, 3)}), r"stick_forces must be four numbers \(N\), one for each wheel; got .1"),
    ((skid_steer, {"slip_forces": (1, 2, 3, np.nan)}), r"slip_forces\[3\] must be finite; got nan"),
    ((skid_steer, {"m_b": -1.0}), "m_b must be positive; got -1.0"),
    ((skid_steer, {"m_w": -2.5}), "m_w must be 0 or more; got -2.5"),
    ((skid_steer, {"c_1": np.nan}), "c_1 must be finite; got nan"),
    ((skid_steer, {"m_b": "70 kg"}), "m_b must be a number or the name of a parameter; got the name '70 kg'"),
    ((skid_steer, {"m_w": sf.Parameter(2.5)}), "m_w must be a number; got Parameter"),
    ((skid_steer, {"initial_state": [0.0] * 5}), "initial_state must have 6 entries, X, dX, Y, dY, theta, d"),
    ((bicycle, {"initial_state": [0.0] * 6}), "initial_state must have a positive v_x, "),
    ((differential_drive, {"delay": 0.1}), "delay is that of speeds='commanded', or else"),
    ((differential_drive, {"y_l": 0.4, "y_r": 0.4}), "y_l, on the left, must be larger than y_r; got 0"),
    ((differential_drive, {"turn_slip": 2.0}), "turn_slip must be from 0 to 1; got 2.0"),
    by=lambda given: given[0](**given[1]),
)


@pytest.mark.parametrize(
    ("system", "channels", "message"),
    [
        (skid_steer(forces_from_input=True), 3, r"must have 4 channels, F1, F2, F3, F4 \(N\); it has 3"),
        (bicycle(), 1, r"must have 2 channels, delta \(rad\), F_x \(N\); it has 1"),
        (lugre(), 2, r"must have 1 channels, force or position; it has 2"),
    ],
)
def test_an_input_with_other_channels_is_refused(system, channels, message):
    """JAX takes the last channel for those that are missing: three forces would be four."""
    field = list(system.modes.values())[-1]
    p = dict.fromkeys((*BRISTLES, "m", "I_z", "a", "b", "C_f", "C_r", "mu"), 1.0)
    with pytest.raises(ValueError, match=message):
        evaluate(field, np.ones(len(system.state_names)), p, np.ones(channels) if channels > 1 else np.array(1.0))


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
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW_TO_CHECK)) for name in vehicle_coverage.CASES]
)
def test_derivatives_of_each_model_are_right(name):
    """In machine code, without the paper's equations, which take JAX seconds to compile: the study does that."""
    case = vehicle_coverage.CASES[name]()
    engine = Evaluator(case.problem, case.theta).engines[0].engine.name
    assert engine == ("jax" if name in vehicle_coverage.SLOW else "native")
    check = sf.check_derivatives(vehicle_coverage.draw_log(case), paper=False)
    assert check.passed, check


@pytest.mark.slow
def test_derivatives_are_checked_on_a_mesh_for_the_given_theta():
    """The mesh of the first guess, 1 s away, leaves gaps of 3e-3 between the paper's equations and the cost's."""
    case = vehicle_coverage.turn_as_in_the_paper()
    check = sf.check_derivatives(vehicle_coverage.draw_log(case), case.theta)
    assert check.passed, check
    assert max(check.gradient_gap, check.hessian_gap) < 1e-5
