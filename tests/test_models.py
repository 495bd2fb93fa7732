"""The ready models against values worked out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from switchfit.models import BUILT_IN, magic_formula, skid_steer, sliding_block
from switchfit.models.magic_formula import MAGIC_FORMULA, lateral_force, longitudinal_force
from switchfit.problem.functions import use_float64


def value(function, *arguments):
    with jax.enable_x64(True):
        arrays = [
            {k: np.float64(v) for k, v in a.items()} if isinstance(a, dict) else np.array(a, float) for a in arguments
        ]
        return np.asarray(function(*jax.tree.map(jax.numpy.asarray, arrays)))


MU = {"mu": 0.7}
M = 80.0  # 70 + 4 * 2.5
INERTIA = 90.47  # 10 (12 * 0.0625 + 12 * 0.0529) + 70 (0.7921 + 0.3025) = 13.848 + 76.622


def test_skid_steer_names_modes_units_and_start():
    system = skid_steer()
    assert set(system.modes) == {"stick", "slip"}
    assert system.state_names == ("X", "dX", "Y", "dY", "theta", "dtheta")
    assert system.state_units == ("m", "m/s", "m", "m/s", "rad", "rad/s")
    np.testing.assert_array_equal(system.initial_state, np.zeros(6))
    assert not system.reset_maps


def test_stick_from_rest_is_force_over_mass():
    np.testing.assert_allclose(value(skid_steer().modes["stick"], 0.0, np.zeros(6), MU), [0, 0.75, 0, 0, 0, 0])


def test_stick_heading_along_y_with_drag_and_turning():
    x = [3.0, 2.0, 1.0, 4.0, np.pi / 2, 0.5]
    expected = [2.0, -0.72 * 2 / M, 4.0, (60 - 0.72 * 4) / M, 0.5, 0.0]
    np.testing.assert_allclose(value(skid_steer().modes["stick"], 1.0, x, MU), expected, atol=1e-16)


def test_slip_from_rest_turns_by_the_difference_of_the_forces():
    # ddX = 54 / 80; ddtheta = 12 * 0.23 * (27 - 0 - 0 + 27) / INERTIA
    expected = [0, 0.675, 0, 0, 0, 149.04 / INERTIA]
    np.testing.assert_allclose(value(skid_steer().modes["slip"], 0.0, np.zeros(6), MU), expected, rtol=1e-14)


def test_slip_at_a_general_heading():
    # theta = 30 degrees, dX = 2, dY = 1: v = -0.5 * 2 + 0.8660254037844386 * 1 = -0.1339745962155614
    s, c, v = 0.5, 0.8660254037844386, -0.1339745962155614
    x = [0.0, 2.0, 0.0, 1.0, np.pi / 6, 0.3]
    ddX = (54 * c - 0.92 * 2) / M + 9.81 * 0.7 * s * v
    ddY = (54 * s - 0.92 * 1) / M - 9.81 * 0.7 * c * v
    ddtheta = (149.04 - 0.75 * 9.81 * 80 * 0.7 * 0.3) / INERTIA
    np.testing.assert_allclose(
        value(skid_steer().modes["slip"], 0.0, x, MU), [2, ddX, 1, ddY, 0.3, ddtheta], rtol=1e-13
    )
    # and as numbers, worked out apart from the formulas above
    assert (ddX, ddY, ddtheta) == pytest.approx((0.10156537, 1.12274644, 0.28113187), abs=2e-8)


def test_lateral_friction_acts_against_the_lateral_velocity_only():
    slip = skid_steer(slip_forces=(0, 0, 0, 0), c_2=0.0).modes["slip"]
    for theta in (0.0, 0.7, 2.5):
        along, across = np.array([np.cos(theta), np.sin(theta)]), np.array([-np.sin(theta), np.cos(theta)])
        velocity = 1.5 * along + 0.4 * across
        rate = value(slip, 0.0, [0, velocity[0], 0, velocity[1], theta, 0.0], MU)
        acceleration = rate[[1, 3]]
        assert acceleration @ along == pytest.approx(0.0, abs=1e-14)
        assert acceleration @ across == pytest.approx(-9.81 * 0.7 * 0.4, rel=1e-13)


def test_every_constant_matters():
    x = np.array([0.1, 2.0, 0.2, 1.0, 0.6, 0.3])
    base = {mode: value(f, 0.0, x, MU) for mode, f in skid_steer().modes.items()}
    for name in ("m_b", "m_w", "B_l", "B_w", "a", "b", "c_1", "c_2", "g"):
        changed = {mode: value(f, 0.0, x, MU) for mode, f in skid_steer(**{name: 1.3}).modes.items()}
        assert any(not np.allclose(base[mode], changed[mode], rtol=1e-6) for mode in base), name


def test_wheel_forces_by_mode():
    system = skid_steer(stick_forces=(1, 2, 3, 4), slip_forces=(5, 1, 2, 4))
    assert value(system.modes["stick"], 0.0, np.zeros(6), MU)[1] == pytest.approx(10 / 80)
    rate = value(system.modes["slip"], 0.0, np.zeros(6), MU)
    assert rate[1] == pytest.approx(12 / 80)
    assert rate[5] == pytest.approx(12 * 0.23 * (5 - 1 - 2 + 4) / INERTIA)


def test_restick_reset_keeps_position_heading_and_forward_velocity():
    system = skid_steer(restick="reset")
    x = [3.0, 2.0, -1.0, 1.0, np.pi / 6, 0.3]
    forward = 0.8660254037844386 * 2 + 0.5 * 1
    expected = [3.0, forward * 0.8660254037844386, -1.0, forward * 0.5, np.pi / 6, 0.0]
    np.testing.assert_allclose(value(system.reset_maps["slip", "stick"], 8.0, x, MU), expected, rtol=1e-14)
    assert set(system.reset_maps) == {("slip", "stick")}


def test_skid_steer_refuses():
    with pytest.raises(ValueError, match=r"restick must be 'continuous' or 'reset'; got 'jump'"):
        skid_steer(restick="jump")
    with pytest.raises(ValueError, match=r"slip_forces must be four numbers \(N\), one for each wheel"):
        skid_steer(slip_forces=(27.0, 27.0))


P = {"mu": 0.2, "x0": 1.0, "y0": 2.0, "vx0": 3.0, "vy0": -4.0}


def test_sliding_block_decelerates_along_its_first_velocity():
    system = sliding_block()
    np.testing.assert_array_equal(value(system.initial_state, P), [1, 2, 3, -4])
    rate = value(system.modes["slide"], 0.0, [1, 2, 3, -4], P)
    np.testing.assert_allclose(rate, [3, -4, -0.2 * 9.81 * 0.6, 0.2 * 9.81 * 0.8], rtol=1e-14)
    np.testing.assert_allclose(value(sliding_block(g=1.0).modes["slide"], 0.0, [1, 2, 3, -4], P)[2:], [-0.12, 0.16])


def test_sliding_block_is_smooth_where_it_would_stop_and_rests_in_stick():
    system = sliding_block()
    at_rest = value(system.modes["slide"], 2.0, [1, 2, 0, 0], P)
    jacobian = value(jax.jacfwd(system.modes["slide"], argnums=1), 2.0, np.array([1.0, 2.0, 0.0, 0.0]), P)
    assert np.isfinite(at_rest).all()
    np.testing.assert_array_equal(jacobian, np.eye(4, k=2))
    np.testing.assert_array_equal(value(system.modes["stick"], 2.0, [1, 2, 0.1, 0], P), np.zeros(4))


def test_every_built_in_model_can_be_made():
    for name, factory in BUILT_IN.items():
        assert factory.__name__ == name
        assert factory().state_names


# --- the Magic Formula ------------------------------------------------------------------------------------------------


def test_magic_formula_against_values_worked_out_apart():
    """Coefficients of Bakker, Nyborg and Pacejka (1987): lateral at 5 degrees, longitudinal at 10 %, 2 to 8 kN."""
    lateral = [float(lateral_force(5.0, load, MAGIC_FORMULA)) for load in (2, 4, 6, 8)]
    longitudinal = [float(longitudinal_force(10.0, load, MAGIC_FORMULA)) for load in (2, 4, 6, 8)]
    np.testing.assert_allclose(lateral, [1828.90, 3389.60, 4409.00, 4821.91], rtol=0, atol=0.006)
    np.testing.assert_allclose(longitudinal, [2191.82, 4234.44, 6090.57, 7736.34], rtol=0, atol=0.006)


def on_tyres(x, treads, **constants):
    """Accelerations (ddX, ddY, ddtheta) at the state `x` with treads moving at the given speeds (m/s)."""
    with use_float64():
        drive = magic_formula(wheel_radius=0.2, **constants).modes["drive"]
        rate = drive(0.0, jnp.asarray(x), dict(MAGIC_FORMULA), jnp.asarray(treads) / 0.2)
    np.testing.assert_array_equal(np.asarray(rate)[[0, 2, 4]], np.asarray(x)[[1, 3, 5]])
    return np.asarray(rate)[[1, 3, 5]]


def test_tyres_that_roll_feel_no_force():
    np.testing.assert_allclose(on_tyres([1.0, 3.0, 2.0, 4.0, np.arctan2(4, 3), 0.0], [5.0] * 4), 0.0, atol=1e-12)


def test_small_slip_ratio_gives_the_longitudinal_force_at_that_slip():
    V, slip, load = 4.0, 0.03, 1e-3 * 9.81 * 80 / 4
    forward, sideways, yaw = on_tyres([0.0, V, 0.0, 0.0, 0.0, 0.0], [V * (1 + slip)] * 4, low_speed=1e-6)
    expected = 4 * float(longitudinal_force(100 * slip, load, MAGIC_FORMULA)) / 80
    assert forward == pytest.approx(expected, rel=0.02)  # the mean of both speeds is not the hub's: half of 3 %
    assert abs(sideways) + abs(yaw) < 1e-12


def test_small_slip_angle_gives_the_lateral_force_at_that_angle():
    V, angle, load = 4.0, np.radians(2.0), 1e-3 * 9.81 * 80 / 4
    forward, sideways, yaw = on_tyres([0.0, V, 0.0, V * np.tan(angle), 0.0, 0.0], [V] * 4, low_speed=1e-6)
    expected = -4 * float(lateral_force(2.0, load, MAGIC_FORMULA)) / 80
    assert sideways == pytest.approx(expected, rel=1e-3)  # 1e-3: the slip below which the force is linear
    assert abs(forward) + abs(yaw) < 1e-12


def test_faster_wheels_on_the_right_turn_to_the_left():
    """Wheels 1 and 4 are the right ones, as in equation (18); in the limit of small slip by hand."""
    V, slip, load = 5.0, 1e-5, 1e-3 * 9.81 * 80 / 4
    forward, _, yaw = on_tyres(
        [0.0, V, 0.0, 0.0, 0.0, 0.0], [V * (1 + slip), V * (1 - slip), V * (1 - slip), V * (1 + slip)], low_speed=1e-6
    )
    stiffness = float(longitudinal_force(0.1, load, MAGIC_FORMULA)) / 1e-3  # at the slip below which it is linear
    inertia = 70 * (0.89**2 + 0.55**2) / 12 + 10 * (0.25**2 + 0.23**2)
    assert yaw == pytest.approx(4 * 0.23 * stiffness * slip / inertia, rel=1e-3)
    assert abs(forward) < 1e-6


def test_yaw_is_damped_by_all_wheels():
    V, rate, load = 5.0, 1e-6, 1e-3 * 9.81 * 80 / 4
    yaw = on_tyres([0.0, V, 0.0, 0.0, 0.0, rate], [V] * 4, low_speed=1e-6)[2]
    longitudinal = float(longitudinal_force(0.1, load, MAGIC_FORMULA)) / 1e-3
    lateral = float(lateral_force(np.degrees(1e-3), load, MAGIC_FORMULA)) / 1e-3
    inertia = 70 * (0.89**2 + 0.55**2) / 12 + 10 * (0.25**2 + 0.23**2)
    expected = -4 * (longitudinal * 0.23**2 + lateral * 0.25**2) * rate / V / inertia
    assert yaw == pytest.approx(expected, rel=1e-3)


def test_forces_do_not_depend_on_the_heading():
    turn = 0.7
    c, s = np.cos(turn), np.sin(turn)
    straight = on_tyres([0.0, 3.0, 0.0, 0.4, 0.0, 0.2], [3.5, 3.0, 2.0, 4.0])
    turned = on_tyres([0.0, 3 * c - 0.4 * s, 0.0, 3 * s + 0.4 * c, turn, 0.2], [3.5, 3.0, 2.0, 4.0])
    along, across, yaw = straight
    np.testing.assert_allclose(turned, [c * along - s * across, s * along + c * across, yaw], rtol=1e-12)


def test_standstill_is_smooth_and_the_force_bounded():
    rest = on_tyres([0.0] * 6, [0.0] * 4)
    np.testing.assert_array_equal(rest, 0.0)
    spinning = on_tyres([0.0] * 6, [20.0] * 4)
    assert 0 < spinning[0] < 1.2 * 9.81


@pytest.mark.parametrize("name", ["wheel_radius", "low_speed"])
def test_magic_formula_refuses_what_is_not_positive(name):
    with pytest.raises(ValueError, match=f"{name} must be positive; got 0"):
        magic_formula(**{name: 0.0})
