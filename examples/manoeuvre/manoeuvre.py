"""Which manoeuvre tells the friction of a skid-steered vehicle in the shortest time?

The vehicle of Miller and Murphey drives straight ahead, and its wheels break loose after 0.6 s; their currents show
when, to 0.05 s. GPS gives its position to 5 cm, ten times a second. What should the four wheels do, each within 0 to
30 N, so that the friction mu is known to 0.02 as soon as possible? Run it:

    python examples/manoeuvre/manoeuvre.py [--out DIR]
"""

import argparse
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from switchfit.models import skid_steer
from switchfit.models.skid_steer import SLIP_FORCES, STICK_FORCES

VEHICLE = skid_steer(forces_from_input=True)
WHEELS = ("front right", "front left", "rear left", "rear right")
MU, BREAKS_LOOSE, WANTED = 0.7, 0.6, 0.02
STRONGEST = 30.0  # N
DURATIONS = (2.0, 2.5, 3.0, 3.5, 4.0)  # s


def position(t, x, p):
    """Where the GPS is."""
    return x[jnp.array([0, 2])]


def plan_run(duration):
    """The manoeuvre of the paper, straight ahead and then a turn; the forces may change every quarter of a second."""
    times = np.arange(1, round(10 * duration) + 1) / 10
    gps = sf.Measurements(times, np.zeros((len(times), 2)), observe=position, sigma=0.05, names=("X", "Y"))
    knots = np.arange(0.0, duration, 0.25)
    forces = np.where(knots[:, None] < BREAKS_LOOSE, STICK_FORCES, SLIP_FORCES)
    loose = sf.Parameter(BREAKS_LOOSE, prior=sf.Normal(BREAKS_LOOSE, 0.05))
    run = sf.Experiment(gps, ("stick", "slip"), (loose,), 0.0, duration, inputs=sf.Input(knots, forces))
    return sf.Problem(VEHICLE, run, {"mu": sf.Parameter(MU, lower=0.05, upper=2.0)})


def find(durations=DURATIONS, **settings):
    """The best manoeuvre of each duration, for mu alone; when the wheels break loose is estimated beside it."""
    return {T: sf.design(plan_run(T), free={"u": (0.0, STRONGEST)}, names="mu", **settings) for T in durations}


def errors_of(plans):
    """Standard errors of mu for each duration, as in the paper and as designed."""
    k = plan_run(DURATIONS[0]).theta_names.index("mu")
    return np.array([[plan.standard_errors_before[k], plan.standard_errors[k]] for plan in plans.values()])


def measure_durations(plans):
    """How long it takes until mu is known to the wanted error, by the paper's manoeuvre and by the designed ones."""
    logs = np.log(errors_of(plans))
    return [float(np.interp(-np.log(WANTED), -column, list(plans), np.nan, np.nan)) for column in logs.T]


def table(plans):
    """Standard errors of mu by duration, as text."""
    lines = ["duration (s)  as in the paper  as designed"]
    lines += [f"{T:12}  {given:15.4f}  {best:11.4f}" for T, (given, best) in zip(plans, errors_of(plans), strict=True)]
    paper, best = measure_durations(plans)
    return "\n".join([*lines, f"mu is known to {WANTED} after {paper:.2f} s, or {best:.2f} s with the best manoeuvre"])


def plot(plans, shown=3.0):
    """Standard errors by duration; the forces of one designed manoeuvre; its path and that of the paper's."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.4, 4.6), layout="constrained")
    axes = figure.subplot_mosaic([["errors", "forces"], ["errors", "path"]], width_ratios=(2, 3))
    ax, plan = axes["errors"], plans[shown]
    for errors, label, colour in zip(errors_of(plans).T, ("paper", "designed"), ("#777777", "#b2182b"), strict=True):
        ax.semilogy(list(plans), errors, "o-", color=colour, label=label, markersize=4)
    ax.axhline(WANTED, color="#222222", linewidth=0.8, linestyle="--")
    ax.set(xlabel="duration (s)", ylabel="standard error of mu")
    ax.legend(frameon=False)

    ax, knots = axes["forces"], plan.problem.experiments[0].inputs.times
    for name, forces, style in zip(WHEELS, plan.inputs.values(), ("-", "--", "-.", ":"), strict=True):
        ax.step([*knots, shown], [*forces, forces[-1]], style, where="post", label=name)
    ax.axvline(BREAKS_LOOSE, color="#777777", linewidth=0.8)
    ax.set(xlabel="time (s)", ylabel="force (N)", ylim=(-2, 46))
    ax.legend(frameon=False, ncols=2, fontsize="small", loc="upper left")

    ax = axes["path"]
    for path, label, colour in (
        (sf.simulate(plan.given), "paper", "#777777"),
        (plan.trajectory, "designed", "#b2182b"),
    ):
        ax.plot(path.states[:, 0], path.states[:, 2], color=colour, label=label)
    ax.set(xlabel="X (m)", ylabel="Y (m)", aspect="equal", xmargin=0.05)
    return figure


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, metavar="DIR", help="Folder for manoeuvre.png and the best manoeuvre.")
    folder = parser.parse_args().out
    found = find()
    print(table(found))
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        plot(found).savefig(folder / "manoeuvre.png", dpi=150)
        found[3.0].save(folder / "design.json")
