"""Ten tosses of a cube at once: does one friction coefficient explain them all?

Every toss has a moment at which the cube sticks, and a state at the start, which nobody has measured: these are its
own. The friction coefficient is shared, or each toss has one too. Run it:

    python examples/tosses/tosses.py
"""

import csv
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import scipy.stats

import switchfit as sf

GRAVITY = 9.81  # m/s^2


def slide(t, x, p):
    """Coulomb friction slows the cube down; it stays on a straight line."""
    speed, heading = x[2], x[3]
    return jnp.stack([speed * jnp.cos(heading), speed * jnp.sin(heading), -p["mu"] * GRAVITY, jnp.zeros(())])


def stick(t, x, p):
    """The cube rests; a speed left over would be a misfit."""
    return jnp.zeros(4)


def position(t, x, p):
    """What is tracked."""
    return x[:2]


CUBE = sf.HybridSystem(
    modes={"slide": slide, "stick": stick},
    initial_state=np.zeros(4),
    state_names=("x", "y", "speed", "heading"),
    state_units=("m", "m", "m/s", "rad"),
)


def read():
    """Times from 0 (K,) and positions (K, 2) of each toss, from the moment the cube lies flat."""
    with Path(__file__).with_name("tosses.csv").open(newline="", encoding="utf-8") as file:
        table = np.array([[float(entry) for entry in row] for row in list(csv.reader(file))[1:]])
    tosses = [table[table[:, 0] == number] for number in np.unique(table[:, 0])]
    return [(rows[:, 1] - rows[0, 1], rows[:, 2:]) for rows in tosses]


def guess(times, positions):
    """Deceleration, moment of rest and state at the start, from a parabola through the path before it ends."""
    line = positions[-1] - positions[0]
    length = np.hypot(*line)
    along = (positions - positions[0]) @ line / length
    moving = along < 0.97 * length
    bend, speed, _ = np.polyfit(times[moving], along[moving], 2)
    deceleration = max(-2 * bend, 0.5)
    rest = np.clip(speed / deceleration, 0.2 * times[-1], 0.95 * times[-1])
    return deceleration, rest, [*positions[0], speed, np.arctan2(line[1], line[0])]


def make_problem(tosses=None, *, one_mu=True):
    """The joint fit: a mu for all of them, or each its own."""
    tosses = read() if tosses is None else tosses
    guesses = [guess(*toss) for toss in tosses]
    runs, each = [], {}
    for k, ((times, positions), (deceleration, rest, start)) in enumerate(zip(tosses, guesses, strict=True)):
        each[f"mu_{k}"] = sf.Parameter(deceleration / GRAVITY, lower=0.01, upper=2.0, unit="1")
        runs.append(
            sf.Experiment(
                sf.Measurements(times, positions, observe=position, names=("x", "y")),
                mode_sequence=("slide", "stick"),
                transition_times=(sf.Parameter(rest, lower=0.02, upper=times[-1] - 1e-3),),
                t0=0.0,
                tf=times[-1],
                initial_state=[sf.Parameter(value) for value in start],
                parameter_map=None if one_mu else {"mu": f"mu_{k}"},
                name=f"toss{k}",
            )
        )
    shared = np.median([deceleration for deceleration, _, _ in guesses]) / GRAVITY
    return sf.Problem(CUBE, runs, {"mu": sf.Parameter(shared, lower=0.01, upper=2.0, unit="1")} if one_mu else each)


def start_from(each):
    """A start for one mu, from the fit with a mu for each: all that is each toss's own, and the median mu.

    A joint fit has many local minima, which differ in the sample intervals in which the cubes come to rest; from here
    it finds one that is 0.01 % above the lowest that 64 other starts have led to.
    """
    times, states = np.concatenate(each.transition_times), np.concatenate(each.initial_state)
    return np.concatenate([times, [np.median(list(each.parameters.values()))], states])


def is_one_enough(one, each):
    """F test of one mu against one for each toss: F, and the probability of such an F if one were enough.

    The noise is unknown, so that it is judged by the residuals: a cost is half the sum of their squares.
    """
    more = len(each.theta) - len(one.theta)
    left = each.samples - len(each.theta)
    F = (one.cost - each.cost) / more / (each.cost / left)
    return F, scipy.stats.f.sf(F, more, left)


if __name__ == "__main__":
    each = sf.estimate(make_problem(one_mu=False))
    one = sf.estimate(make_problem(), start=start_from(each))
    print(one)
    print("\nOne mu for each toss:")
    errors = dict(zip(each.theta_names, each.standard_errors, strict=True))
    for name in each.parameters:
        print(f"  {name}  {each.parameters[name]:.4f} ± {errors[name]:.4f}")
    for fit, what in ((one, "one mu"), (each, "ten mu")):
        print(f"{what}: cost {fit.cost:.4e}, sigma about {1e3 * np.sqrt(fit.residual_variance):.3f} mm")
    F, probability = is_one_enough(one, each)
    print(f"F = {F:.1f}: if one mu were enough, the probability of that would be {probability:.1e}.")
