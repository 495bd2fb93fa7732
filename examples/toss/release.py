"""A tossed cube from release to rest: flight, four impacts, landing, slide, stick, from positions alone.

The cube spins and lands on a corner, an edge, a corner; what an impact does to the velocity of its centre depends on
how it lies then, which is not modelled. So every impact has its own restitution of the vertical velocity, its own part
of the speed that is left, and its own change of heading, in the reset map of that transition; all are estimated, with
the six transition times, the friction, and the state at release: 27 unknowns. Run it:

    python examples/toss/release.py [folder for figures]
"""

import csv
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import switchfit as sf

GRAVITY = 9.81  # m/s^2
IMPACTS = 4
SEEN = (0.091, 0.158, 0.213, 0.279, 0.310)
"""When the vertical velocity of the log turns (s): four impacts, and the landing after which the cube stays down."""
STICKS = 0.70


def flight(t, x, p):
    """Free fall; speed and heading of the horizontal motion stay."""
    _, _, _, speed, heading, rise = x
    return jnp.stack([speed * jnp.cos(heading), speed * jnp.sin(heading), rise, 0.0 * t, 0.0 * t, -GRAVITY + 0.0 * t])


def slide(t, x, p):
    """Coulomb friction slows the cube down on its way; it stays on the table."""
    _, _, _, speed, heading, _ = x
    slowing = -p["mu"] * GRAVITY
    return jnp.stack([speed * jnp.cos(heading), speed * jnp.sin(heading), 0.0 * t, slowing, 0.0 * t, 0.0 * t])


def stick(t, x, p):
    """The cube rests."""
    return jnp.zeros(6)


def impact(k):
    """Reset map of impact k; after the last one, the landing, nothing is left of the vertical velocity."""

    def reset(t, x, p):
        X, Y, Z, speed, heading, rise = x
        up = 0.0 * rise if k == IMPACTS else -p["restitution"][k] * rise
        return jnp.stack([X, Y, Z, p["kept"][k] * speed, heading + p["turn"][k], up])

    return reset


SEQUENCE = (*(f"flight {k}" for k in range(IMPACTS + 1)), "slide", "stick")
CUBE = sf.HybridSystem(
    modes=dict.fromkeys(SEQUENCE[:-2], flight) | {"slide": slide, "stick": stick},
    initial_state=np.zeros(6),
    reset_maps={(SEQUENCE[k], SEQUENCE[k + 1]): impact(k) for k in range(IMPACTS + 1)},
    state_names=("x", "y", "z", "speed", "heading", "rise"),
    state_units=("m", "m", "m", "m/s", "rad", "m/s"),
)


def read():
    """Times (K,) and positions (K, 3) of the whole toss."""
    with Path(__file__).with_name("toss_000.csv").open(newline="", encoding="utf-8") as file:
        table = np.array([[float(entry) for entry in row[:4]] for row in list(csv.reader(file))[1:]])
    return table[:, 0], table[:, 1:]


def make_problem():
    """The fit, with first guesses from differences of the log; impacts may move by 10 ms."""
    times, positions = read()
    start = positions[0]
    vx, vy, vz = (positions[1] - positions[0]) / (times[1] - times[0])
    at_release = [*start, np.hypot(vx, vy), np.arctan2(vy, vx), vz]
    run = sf.Experiment(
        sf.Measurements(times, positions, observe=lambda t, x, p: x[:3], names=("x", "y", "z")),
        SEQUENCE,
        (*(sf.Parameter(seen, lower=seen - 0.01, upper=seen + 0.01) for seen in SEEN), STICKS),
        t0=0.0,
        tf=times[-1],
        initial_state=[sf.Parameter(value) for value in at_release],
    )
    parameters = {
        "mu": sf.Parameter(0.3, lower=0.01, upper=2.0, unit="1"),
        "restitution": sf.Parameter(np.full(IMPACTS, 0.3), unit="1"),
        "kept": sf.Parameter(np.full(IMPACTS + 1, 0.9), lower=0.0, unit="1"),
        "turn": sf.Parameter(np.zeros(IMPACTS + 1), unit="rad"),
    }
    return sf.Problem(CUBE, run, parameters)


if __name__ == "__main__":
    estimate = sf.estimate(make_problem())
    print(estimate)
    print(estimate.residuals)
    if len(sys.argv) > 1:
        folder = Path(sys.argv[1])
        folder.mkdir(parents=True, exist_ok=True)
        estimate.plot().savefig(folder / "release.png", dpi=150)
