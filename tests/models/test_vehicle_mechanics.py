"""Vehicles against mechanics that is derived from energies: what JAX differentiates here are positions of points.

No equation of motion is written down. A body is a set of mass points whose positions are functions of the coordinates
q; forces act on points, dissipation and potential are functions of velocities and places, and constraints hold the
velocities of points. Kinetic energy, generalized forces (virtual work) and constraints then follow by derivatives.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from switchfit.models import bicycle, differential_drive, rolling_body, skid_steer
from switchfit.models.skid_steer import STUCK_AXLES

G = 9.81


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def evaluate(function, x, p, *u):
    """A function of a model, compiled once for all of its arguments."""
    given = {k: jnp.asarray(v) for k, v in p.items()}
    return np.asarray(jax.jit(function)(0.0, jnp.asarray(x), given, *map(jnp.asarray, u)))


# --- plane mechanics from energies ------------------------------------------------------------------------------------


def place(point, q):
    """Position (2,) of a point of the body at q = (X, Y, theta)."""
    cos, sin = jnp.cos(q[2]), jnp.sin(q[2])
    return q[:2] + jnp.array([cos * point[0] - sin * point[1], sin * point[0] + cos * point[1]])


def velocity(point, q, dq):
    """Velocity (2,) of a point, by the derivative of its position."""
    return jax.jvp(lambda q: place(point, q), (q,), (dq,))[1]


def in_body(vector, q):
    """Components of a vector along and across the body."""
    cos, sin = jnp.cos(q[2]), jnp.sin(q[2])
    return jnp.array([cos * vector[0] + sin * vector[1], -sin * vector[0] + cos * vector[1]])


def kinetic(masses, q, dq):
    """Kinetic energy of mass points {point: mass}."""
    velocities = jax.vmap(lambda point: velocity(point, q, dq))(jnp.array(list(masses)))
    return 0.5 * jnp.array(list(masses.values())) @ jnp.sum(velocities**2, axis=1)


def balance(masses, q, dq, generalized, constraints=None):
    """Mass matrix (3, 3) and force (3,) of d/dt dT/dq' - dT/dq = Q + A' lambda; A and what stands beside A q'' in the
    derivative of A(q) q' = 0 in time.

    generalized: Q (3,) at q and q'. constraints: function of q and q', linear in q', whose values stay zero.
    """
    mass = jax.hessian(kinetic, argnums=2)(masses, q, dq)
    momentum = jax.grad(kinetic, argnums=2)
    drift = jax.jvp(lambda q: momentum(masses, q, dq), (q,), (dq,))[1] - jax.grad(kinetic, argnums=1)(masses, q, dq)
    if constraints is None:
        return mass, generalized - drift, None, None
    A = jax.jacfwd(constraints, argnums=1)(q, dq)
    return mass, generalized - drift, A, jax.jvp(lambda q: constraints(q, dq), (q,), (dq,))[1]


def accelerate(mass, force, A, rest):
    """Accelerations (3,) of what `balance` returns."""
    free = np.linalg.solve(mass, force)
    if A is None:
        return free
    # The admissible accelerations are a particular one plus the null space, in which the reactions do no work.
    particular = np.linalg.lstsq(A, -rest, rcond=None)[0]
    _, sizes, rows = np.linalg.svd(A)
    basis = rows[len(sizes) :].T
    if not basis.size:
        return particular
    along = np.linalg.solve(basis.T @ mass @ basis, basis.T @ mass @ (free - particular))
    return particular + basis @ along


@jax.jit
def inertia_of_vehicle(q, dq):
    """Mass matrix (3, 3) of `MASSES`."""
    return jax.hessian(kinetic, argnums=2)(MASSES, q, dq)


def work_of(point, force, q):
    """Generalized force (3,) of a force (2,) at a point, by its virtual work."""
    return jax.jacfwd(lambda q: place(point, q))(q).T @ force


# --- the skid-steered vehicle -----------------------------------------------------------------------------------------

BODY, WHEEL, SIZE, HALF = 70.0, 2.5, (0.89, 0.55), (0.25, 0.23)
WHEELS = ((HALF[0], -HALF[1]), (HALF[0], HALF[1]), (-HALF[0], HALF[1]), (-HALF[0], -HALF[1]))
"""Front right, front left, rear left, rear right: the order of F1 to F4."""
AXLES = {1: (HALF[0], 0.0), -1: (-HALF[0], 0.0)}
GROUND = {"mf": 0.8, "mr": 0.5, "kf": 0.3, "kr": 0.2, "rho": 0.02, "sx": 0.03, "sy": -0.05}
SMALL = 0.01


def gather_masses():
    """The body, a rectangle, as four points of two-point Gauss quadrature, exact for its inertia; and four wheels."""
    x, y = (side / (2 * np.sqrt(3)) for side in SIZE)
    masses = {(sx * x, sy * y): BODY / 4 for sx in (1, -1) for sy in (1, -1)}
    return masses | dict.fromkeys(WHEELS, WHEEL)


MASSES = gather_masses()
WEIGHT = G * sum(MASSES.values())


def lateral_speed(side, q, dq):
    return in_body(velocity(AXLES[side], q, dq), q)[1]


def dissipate(q, dq, mode, drag):
    """Rayleigh's function, whose derivatives are the frictions: of the drag, the axles that slip, and rolling."""
    found = 0.5 * drag * jnp.sum(dq[:2] ** 2)
    along = in_body(dq[:2], q)[0]
    found += WEIGHT * GROUND["rho"] * jnp.sqrt(along**2 + SMALL**2)
    for side, viscous, coulomb in ((1, "mf", "kf"), (-1, "mr", "kr")):
        if side not in STUCK_AXLES[mode]:
            v = lateral_speed(side, q, dq)
            found += WEIGHT / 2 * (GROUND[viscous] * v**2 / 2 + GROUND[coulomb] * jnp.sqrt(v**2 + SMALL**2))
    return found


def lift(q):
    """Potential energy on a plane that rises along X and Y."""
    return WEIGHT * (GROUND["sx"] * q[0] + GROUND["sy"] * q[1])


def hold(mode):
    """Lateral speeds of the axles that stick."""
    return lambda q, dq: jnp.stack([lateral_speed(side, q, dq) for side in STUCK_AXLES[mode]])


@cache
def slopes_of_hold(mode):
    """Derivatives of `hold` with respect to q', a compiled function of q and q'."""
    return jax.jit(jax.jacfwd(hold(mode), argnums=1))


def admit(mode, q, dq):
    """The part of a velocity that the axles which stick admit."""
    if not STUCK_AXLES[mode]:
        return dq
    A = np.asarray(slopes_of_hold(mode)(q, dq))
    return dq - np.linalg.pinv(A) @ A @ dq


def make_skid_steer(**settings):
    names = {"mu_front": "mf", "mu_rear": "mr", "coulomb_front": "kf", "coulomb_rear": "kr"}
    grounds = {"rolling": "rho", "slope_x": "sx", "slope_y": "sy", "small_speed": SMALL}
    return skid_steer(modes=tuple(STUCK_AXLES), restick="reset", **names, **grounds, **settings)


@pytest.mark.parametrize("mode", STUCK_AXLES)
def test_skid_steer_follows_from_its_energies(mode):
    field = make_skid_steer(forces_from_input=True).modes[mode]
    random = np.random.default_rng(5)

    @jax.jit
    def sum_forces(q, dq, forces):
        ahead = jnp.array([jnp.cos(q[2]), jnp.sin(q[2])])
        Q = jax.vmap(lambda wheel, F: work_of(wheel, F * ahead, q))(jnp.array(WHEELS), forces).sum(0)
        Q = Q - jax.grad(dissipate, argnums=1)(q, dq, mode, 0.72 if mode == "stick" else 0.92) - jax.grad(lift)(q)
        return balance(MASSES, q, dq, Q, hold(mode) if STUCK_AXLES[mode] else None)

    for _ in range(5):
        q = jnp.array(random.uniform(-3, 3, 3))
        dq = jnp.asarray(admit(mode, q, random.normal(size=3)))
        forces = random.uniform(-20, 30, 4)
        ddq = accelerate(*sum_forces(q, dq, jnp.asarray(forces)))
        x = np.ravel(np.column_stack([q, dq]))
        rates = evaluate(field, x, GROUND, forces)
        np.testing.assert_allclose(rates[[1, 3, 5]], ddq, rtol=1e-11, atol=1e-12)


def test_resets_keep_the_momentum_along_what_the_axles_admit():
    """And stop the axles: six conditions for each pair of modes that leave one velocity."""
    random = np.random.default_rng(6)
    for (before, after), reset in make_skid_steer().reset_maps.items():
        q = jnp.array(random.uniform(-3, 3, 3))
        dq = jnp.asarray(admit(before, q, random.normal(size=3)))
        x = np.ravel(np.column_stack([q, dq]))
        found = evaluate(reset, x, GROUND)
        np.testing.assert_array_equal(found[::2], q)
        jump = jnp.asarray(found[1::2]) - dq
        np.testing.assert_allclose(jax.jit(hold(after))(q, jnp.asarray(found[1::2])), 0.0, atol=1e-13)
        momentum = np.asarray(inertia_of_vehicle(q, dq)) @ jump
        for admitted in np.eye(3):
            assert momentum @ admit(after, q, admitted) == pytest.approx(0.0, abs=1e-11)


# --- the bicycle ------------------------------------------------------------------------------------------------------

CAR = {"m": 1500.0, "I_z": 2500.0, "a": 1.2, "b": 1.4, "C_f": 8e4, "C_r": 9e4, "mu": 0.6}


@pytest.mark.parametrize("mode", ["grip", "front_slide", "rear_slide", "slide"])
def test_bicycle_follows_from_forces_on_points(mode):
    """A dumbbell of the same mass and inertia; forces of the ground in the frame of the ground."""
    field = bicycle(modes=("grip", "front_slide", "rear_slide", "slide")).modes[mode]
    arm = np.sqrt(CAR["I_z"] / CAR["m"])
    masses = {(arm, 0.0): CAR["m"] / 2, (-arm, 0.0): CAR["m"] / 2}
    base, random = CAR["a"] + CAR["b"], np.random.default_rng(7)
    sliding = {"grip": "", "front_slide": "f", "rear_slide": "r", "slide": "fr"}[mode]

    @jax.jit
    def sum_forces(q, dq, delta, drive):
        Q = work_of(jnp.zeros(2), drive * jnp.array([jnp.cos(q[2]), jnp.sin(q[2])]), q)
        for axle, at, angle, other, stiffness in (
            ("f", CAR["a"], delta, CAR["b"], CAR["C_f"]),
            ("r", -CAR["b"], 0.0, CAR["a"], CAR["C_r"]),
        ):
            point = jnp.array([at, 0.0])
            v = velocity(point, q, dq)
            if axle in sliding:
                force = -CAR["mu"] * CAR["m"] * G * other / base * v / jnp.linalg.norm(v)
            else:  # across the wheel, by the angle from its velocity to its plane
                left = q[2] + angle + np.pi / 2
                slip = (q[2] + angle - jnp.arctan2(v[1], v[0]) + np.pi) % (2 * np.pi) - np.pi
                force = stiffness * slip * jnp.array([jnp.cos(left), jnp.sin(left)])
            Q = Q + work_of(point, force, q)
        return balance(masses, q, dq, Q)

    def turn(heading, v):
        return place(v, jnp.array([0.0, 0.0, heading]))

    for _ in range(5):
        q, v, r = random.uniform(-3, 3, 3), random.uniform([5, -2], [20, 2]), random.uniform(-1, 1)
        delta, drive = random.uniform(-0.5, 0.5), random.uniform(-500, 3000)
        dq = np.array([*turn(q[2], v), r])
        ddq = accelerate(*sum_forces(q, dq, delta, drive))
        rates = evaluate(field, [*q, *v, r], CAR, [delta, drive])
        np.testing.assert_allclose(rates[:3], dq, rtol=1e-13, atol=1e-13)
        ddXY = jax.jvp(turn, (q[2], v), (r, rates[3:5]))[1]
        np.testing.assert_allclose([*ddXY, rates[5]], ddq, rtol=1e-11, atol=1e-11)


# --- a body that slides and rolls -------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [0.4, 1.0])
@pytest.mark.parametrize(("mode", "v", "omega"), [("skid", 4.0, -20.0), ("spin", 0.5, 90.0), ("roll", 2.2, 20.0)])
def test_power_of_a_rolling_body_is_what_friction_takes(mode, v, omega, k):
    """On a slope: Coulomb's force takes mu N times the speed of the surface, rolling resistance rho N v.

    The moment of momentum about a line on the ground knows nothing of friction: gravity and resistance alone change it.
    A body rolls once its surface rests on the ground.
    """
    R, mu, rho, slope = 0.11, 0.2, 0.01, 0.3
    body = rolling_body(radius=R, inertia=k, mu=mu, rolling=rho, slope=slope)
    start, known = [0.0, v, omega], {"v_0": v, "omega_0": omega}
    dx, dv, domega = evaluate(body.modes[mode], start, known)
    assert dx == v
    np.testing.assert_array_equal(body.initial_state(known), start)
    for slip in body.guards.values():
        assert evaluate(slip, start, known) == pytest.approx(v - R * omega, rel=1e-12, abs=1e-12)
    power = v * dv + k * R**2 * omega * domega + G * np.sin(slope) * v  # of a unit of mass
    normal = G * np.cos(slope)
    lost = rho * normal * v if mode == "roll" else mu * normal * abs(v - R * omega)
    assert power == pytest.approx(-lost, rel=1e-12)
    resistance = rho * normal if mode == "roll" else 0.0
    assert dv + k * R * domega == pytest.approx(-G * np.sin(slope) - resistance, rel=1e-12)


# --- differential drive -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("first", ["grip", "slip"])
def test_a_vehicle_that_drives_when_the_command_comes_goes_on_as_it_drove(first):
    """While it waits it moves as in the first mode, with all that acts there, and its wheels keep their speeds."""
    other = {"grip": "slip", "slip": "grip"}[first]
    p = {"y_l": 0.9, "y_r": -0.8, "x_v": -0.1, "lag": 0.2, "delay": 0.3, "loss": 0.5}
    system = differential_drive(modes=(first, other), speeds="commanded", delay="delay", turn_slip="loss")
    x, u = [1.0, 2.0, 0.4, 5.0, -1.0], [3.0, 8.0]
    waits, moves = (evaluate(system.modes[name], x, p, u) for name in ("wait", first))
    np.testing.assert_array_equal(waits, [*moves[:3], 0.0, 0.0])
    assert abs(waits[2] - evaluate(system.modes[other], x, p, u)[2]) > 0.5
