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
INERTIA = 90.47  # 10 (12 * 0.0625 + 12 * 0.0529) + 70 (0.7921 + 0.3025) = 13.848 + 76.622


def test_skid_steer_names_modes_units_and_start():
    system = skid_steer()
    assert set(system.modes) == {"stick", "slip"}
    assert system.state_names == ("X", "dX", "Y", "dY", "theta", "dtheta")
    assert system.state_units == ("m", "m/s", "m", "m/s", "rad", "rad/s")
    np.testing.assert_array_equal(system.initial_state, np.zeros(6))
    assert not system.reset_maps


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
