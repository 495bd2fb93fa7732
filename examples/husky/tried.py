"""What was tried so that the Husky's yaw is predicted better than by a static fit: none of it earns its place.

Each change is made to the chosen model of `husky.py` and judged by steps 0 to 9 alone, each predicted by a fit of the
nine others; the last numbers, of steps 10 to 19, decide nothing. Run it:

    python examples/husky/tried.py
"""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import switchfit as sf

HUSKY = runpy.run_path(str(Path(__file__).with_name("husky.py")))
SLIP = HUSKY["DRIVE"].modes["slip"]
RATES = {  # a factor of the yaw rate, with one parameter b and the yaw rate of the model (rad/s)
    "backward": lambda b, rate, u: jnp.where(u[0] + u[1] < 0, 1.0 + b, 1.0),
    "to the left": lambda b, rate, u: jnp.where(rate > 0, 1.0 + b, 1.0),
    "in sharp turns": lambda b, rate, u: 1.0 + b * jnp.abs(u[1] - u[0]) / (jnp.abs(u[0]) + jnp.abs(u[1]) + 0.1),
    "at high rates": lambda b, rate, u: 1.0 + b * rate**2,
}
SPEEDS = {  # a factor of the speed forward, with turn_slip s and the yaw rate (rad/s)
    "by the ratio squared": lambda s, rate, u: 1.0 - s * ((u[1] - u[0]) / (jnp.abs(u[0]) + jnp.abs(u[1]) + 0.1)) ** 2,
    "by the yaw rate": lambda s, rate, u: jnp.exp(-s * jnp.abs(rate)),
}
LATENESS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3)


def scale_rate(factor):
    """Return the vehicle with the yaw rate multiplied by a factor of `RATES`."""

    def slip(t, x, p, u):
        dX, dY, rate = SLIP(t, x, p, u)
        return jnp.stack([dX, dY, rate * factor(p["b"], rate, u)])

    return sf.HybridSystem({"slip": slip}, [0.0] * 3, state_names=("X", "Y", "theta"), state_units=("m", "m", "rad"))


def scale_speed(factor):
    """Return the vehicle with another factor of the speed forward in turns, of `SPEEDS`, in place of `turn_slip`."""

    def slip(t, x, p, u):
        V_l, V_r = HUSKY["RADIUS"] * u[0], HUSKY["RADIUS"] * u[1]
        width = p["y_l"] - p["y_r"]
        rate = (V_r - V_l) / width
        ahead = (V_r * p["y_l"] - V_l * p["y_r"]) / width * factor(p["turn_slip"], rate, u)
        aside = -p["x_v"] * rate
        cos, sin = jnp.cos(x[2]), jnp.sin(x[2])
        return jnp.stack([ahead * cos - aside * sin, ahead * sin + aside * cos, rate])

    return sf.HybridSystem({"slip": slip}, [0.0] * 3, state_names=("X", "Y", "theta"), state_units=("m", "m", "rad"))


def lag_rate():
    """Return the vehicle whose body follows the yaw rate of the model with a first-order lag, from rest."""

    def slip(t, x, p, u):
        dX, dY, rate = SLIP(t, x, p, u)
        return jnp.stack([dX, dY, x[3], (rate - x[3]) / p["lag"]])

    names, units = ("X", "Y", "theta", "rate"), ("m", "m", "rad", "rad/s")
    return sf.HybridSystem({"slip": slip}, [0.0] * 4, state_names=names, state_units=units)


def change_data(problem, **settings):
    """Return a problem with other settings of its poses."""
    runs = [replace(run, data=[replace(run.data[0], **settings)]) for run in problem.experiments]
    return replace_parts(problem, experiments=runs)


def replace_parts(problem, system=None, experiments=None, parameters=None):
    """Return a problem with some of its parts replaced."""
    return sf.Problem(
        system or problem.system, experiments or list(problem.experiments), parameters or dict(problem.parameters)
    )


def free_heading(problem):
    """Return a problem in which the yaw of each step is unknown at its start, within some 0.1 rad."""
    start = [0.0, 0.0, sf.Parameter(0.0, unit="rad", prior=sf.Normal(0.0, 0.1))]
    return replace_parts(problem, experiments=[replace(run, initial_state=start) for run in problem.experiments])


def change_model(system, **more):
    """Return a change of a problem: another vehicle with more parameters."""
    return lambda problem: replace_parts(problem, system=system, parameters=dict(problem.parameters) | more)


def keep(problem):
    """Return a problem as it is."""
    return problem


def split_sigma(problem):
    """Return a problem in which x and y each have a noise of their own."""
    sigmas = dict.fromkeys(("sigma_x", "sigma_y"), HUSKY["NOISE"]["sigma_position"])
    kept = {name: value for name, value in problem.parameters.items() if name != "sigma_position"} | sigmas
    changed = [
        replace(run, data=[replace(run.data[0], sigma=["sigma_x", "sigma_y", "sigma_yaw"])])
        for run in problem.experiments
    ]
    return replace_parts(problem, experiments=changed, parameters=kept)


def fix_sigma_yaw(problem):
    """Return a problem in which yaw weighs three times as much as it does by its errors."""
    return replace_parts(problem, parameters=dict(problem.parameters) | {"sigma_yaw": sf.Parameter(0.1, fixed=True)})


def use_huber(problem):
    """Return a problem with Huber's loss."""
    return change_data(problem, loss="huber", loss_scale=1.5)


FACTOR = sf.Parameter(0.0, lower=-0.9, upper=2.0)
SLIPS = sf.Parameter(0.3, lower=-0.5, upper=3.0)
CHANGES = {  # of the problem that is fitted, and of the one that is predicted
    "as it is": (keep, keep),
    "Huber's loss": (use_huber, keep),
    "sigma of x and of y": (split_sigma, keep),
    "sigma of yaw 0.1 rad": (fix_sigma_yaw, keep),
    "initial yaw unknown": (free_heading, keep),
    "lag of the yaw rate": (change_model(lag_rate(), lag=sf.Parameter(0.1, lower=0.01, upper=1.0, unit="s")),) * 2,
}
CHANGES |= {f"yaw rate {name}": (change_model(scale_rate(factor), b=FACTOR),) * 2 for name, factor in RATES.items()}
CHANGES |= {
    f"turn slip {name}": (change_model(scale_speed(factor), turn_slip=SLIPS),) * 2 for name, factor in SPEEDS.items()
}


def fit(steps, name, late=HUSKY["LATE"]):
    """Return the fit of some steps with a change of the model."""
    return sf.estimate(CHANGES[name][0](HUSKY["make_problem"](steps, late=late)), strategy="local")


def predict(found, steps, name, late=HUSKY["LATE"]):
    """Return poses and errors of some steps, by a fit of others; noise and initial yaw are of no concern."""
    problem = CHANGES[name][1](HUSKY["make_problem"](steps, late=late))
    return HUSKY["collect"](found.validate(problem, refit=()))


def leave_out(name, steps=HUSKY["FITTED"]):
    """Return poses and errors of each step, predicted by a fit of the others."""
    parts = [predict(fit([k for k in steps if k != step], name), [step], name) for step in steps]
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))


def choose_lateness(steps):
    """Return the fit of some steps with the lateness of the encoders at which their cost is lowest, and it."""
    fits = {late: fit(steps, "as it is", late) for late in LATENESS}
    late = min(fits, key=lambda late: fits[late].cost)
    return fits[late], late


def leave_out_with_lateness(steps=HUSKY["FITTED"]):
    """Return poses and errors of each step, and the lateness that the others chose."""
    parts, chosen = [], []
    for step in steps:
        found, late = choose_lateness([k for k in steps if k != step])
        parts.append(predict(found, [step], "as it is", late))
        chosen.append(late)
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True)), chosen


def main():
    """Print how each change predicts steps that it has not seen."""
    print("Shares of x, y, yaw; rms of position (m) and yaw (rad): steps 0 to 9, left out one by one | steps 10 to 19")
    for name in CHANGES:
        found = fit(HUSKY["FITTED"], name)
        scores = HUSKY["score"](*leave_out(name)), HUSKY["score"](*predict(found, HUSKY["OTHER"], name))
        HUSKY["print_scores"](name, *scores)
        more = {key: float(found.parameters[key]) for key in ("b", "lag") if key in found.parameters}
        if more:
            print("   ", ", ".join(f"{key} {value:.3f}" for key, value in more.items()))
    errors, chosen = leave_out_with_lateness()
    found, late = choose_lateness(HUSKY["FITTED"])
    scores = HUSKY["score"](*errors), HUSKY["score"](*predict(found, HUSKY["OTHER"], "as it is", late))
    HUSKY["print_scores"]("lateness chosen by the fit", *scores)
    print("    lateness (s):", " ".join(f"{each:.2f}" for each in chosen), "and of all", late)


if __name__ == "__main__":
    main()
