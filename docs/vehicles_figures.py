"""The pictures of the page on vehicles: each built-in model simulated; drawn when the documentation is built."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import switchfit as sf
from switchfit.models import bicycle, differential_drive, lugre, rolling_body, skid_steer
from switchfit.models.tyre_forces import (
    ALIGNING_MOMENT,
    MAGIC_FORMULA,
    compute_aligning_moment,
    lateral_force,
    longitudinal_force,
)
from switchfit.report.panels import plot_modes
from switchfit.report.style import FIT_COLOUR, LINE_COLOURS, REFERENCE_COLOUR

NOTHING = sf.RunningCost(lambda t, x, p: x @ x)
SIZE = (6.4, 3.2)
STYLES = ("-", (0, (4, 1)), (0, (1, 1)), (0, (4, 1, 1, 1)))
"""Of the modes, in the order of their colours: to be told apart in grey too."""


def draw(folder: Path) -> None:
    """Write a picture of each model."""
    folder.mkdir(exist_ok=True)
    for name, make in PICTURES.items():
        figure = Figure(figsize=SIZE, layout="constrained")
        make(figure)
        figure.savefig(folder / f"vehicle-{name}.svg")


def simulate(
    system: sf.HybridSystem,
    sequence: Sequence[str],
    times: Sequence[float],
    end: float,
    parameters: dict[str, float],
    **settings: Any,
) -> sf.Trajectory:
    """Return the trajectory of a model."""
    inputs = settings.pop("inputs", None)
    start = settings.pop("initial_state", None)
    run = sf.Experiment(NOTHING, tuple(sequence), tuple(times), 0.0, end, inputs=inputs, initial_state=start)
    return sf.simulate(sf.Problem(system, run, parameters, **settings))


def draw_path(ax: Axes, path: sf.Trajectory, places: tuple[int, int, int], size: tuple[float, float]) -> None:
    """Draw a path in the plane, a color and a style for each mode, with outlines of the body in equal steps of time.

    Parameters
    ----------
    ax : Axes
    path : Trajectory
    places : (int, int, int)
        Of X, Y and the heading in the state.
    size : (float, float)
        Length and width of the outlines (m).
    """
    X, Y, heading = (path.states[:, k] for k in places)
    modes = np.array(path.modes)
    for k, mode in enumerate(dict.fromkeys(path.modes)):
        here = np.where(modes == mode, 1.0, np.nan)
        ax.plot(X * here, Y * here, color=LINE_COLOURS[k], linestyle=STYLES[k], label=mode, linewidth=2)
    corners = 0.5 * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 1], [2, 0], [1, -1]]) * size  # with a bow
    for t in np.linspace(path.times[0], path.times[-1], 13):
        k = int(np.searchsorted(path.times, t))
        cos, sin = np.cos(heading[k]), np.sin(heading[k])
        outline = corners @ np.array([[cos, sin], [-sin, cos]]) + [X[k], Y[k]]
        ax.plot(outline[:, 0], outline[:, 1], color=REFERENCE_COLOUR, linewidth=0.8, zorder=1)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("X (m)")
    ax.set_ylabel("Y (m)")
    ax.legend(frameon=False, fontsize=8, loc="upper left")


def draw_skid_steer(figure: Figure) -> None:
    """A drive in which the front slips first, and both axles later; and the lateral speeds of the axles."""
    system = skid_steer(modes=("stick", "front_slip", "slip"), restick="reset", mu_front=0.1, mu_rear=0.3)
    path = simulate(system, ("stick", "front_slip", "slip", "stick"), (2.0, 4.0, 7.0), 9.0, {})
    left, right = figure.subplots(1, 2, width_ratios=(4, 3))
    draw_path(left, path, (0, 2, 4), (1.6, 1.0))
    _, dX, _, dY, theta, turn = path.states.T
    across = -np.sin(theta) * dX + np.cos(theta) * dY
    plot_modes(path, right)
    right.plot(path.times, across + 0.25 * turn, color=FIT_COLOUR, linewidth=2, label="front axle")
    right.plot(path.times, across - 0.25 * turn, color="black", linewidth=1.2, linestyle="--", label="rear axle")
    right.set_ylabel("lateral speed (m/s)")
    right.legend(frameon=False, fontsize=8, loc="lower left")


def draw_differential_drive(figure: Figure) -> None:
    """The same wheel speeds in grip and in slip."""
    speeds = sf.Input([0.0, 3.0, 6.0, 12.0], [[6.0, 6.0], [3.0, 9.0], [8.0, 4.0], [8.0, 4.0]])
    p = {"y_l": 0.75, "y_r": -0.75, "x_v": -0.1}
    ax = figure.subplots()
    for k, mode in enumerate(("grip", "slip")):
        path = simulate(differential_drive(), (mode,), (), 12.0, p, inputs=speeds)
        ax.plot(*path.states.T[:2], color=LINE_COLOURS[k], linestyle=STYLES[k], linewidth=2, label=mode)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("X (m)")
    ax.set_ylabel("Y (m)")
    ax.legend(frameon=False, fontsize=8)


def draw_bicycle(figure: Figure) -> None:
    """A handbrake turn, and the angle between heading and velocity."""
    car = {"m": 1500.0, "I_z": 2500.0, "a": 1.2, "b": 1.4, "C_f": 8e4, "C_r": 9e4, "mu": 0.6}
    steering = sf.Input([0.0, 0.1, 0.6, 2.1, 5.0], [[0, 0], [0, 0], [0.1, 0], [-0.1, 0], [0, 0]], kind="linear")
    start = [0.0, 0.0, 0.0, 15.0, 0.0, 0.0]
    path = simulate(
        bicycle(), ("grip", "rear_slide", "grip"), (0.5, 1.2), 2.6, car, inputs=steering, initial_state=start
    )
    left, right = figure.subplots(1, 2, width_ratios=(4, 3))
    draw_path(left, path, (0, 1, 2), (3.6, 1.7))
    plot_modes(path, right)
    drift = np.degrees(np.arctan2(path.states[:, 4], path.states[:, 3]))
    right.plot(path.times, drift, color=FIT_COLOUR, linewidth=2)
    right.set_ylabel("drift angle (degrees)")


def draw_rolling_body(figure: Figure) -> None:
    """A bowling ball: its speed and that of its surface."""
    when = 7.0 / (0.2 * 9.81 * 3.5)
    p = {"mu": 0.2, "v_0": 7.0, "omega_0": 0.0}
    path = simulate(rolling_body(radius=0.11), ("skid", "roll"), (when,), 2.0, p)
    ax = figure.subplots()
    plot_modes(path, ax)
    ax.plot(path.times, path.states[:, 1], color=FIT_COLOUR, linewidth=2, label="v, of the center")
    ax.plot(path.times, 0.11 * path.states[:, 2], color="black", linewidth=1.2, linestyle="--", label="R ω")
    ax.set_ylabel("speed (m/s)")
    ax.legend(frameon=False, fontsize=8)


def draw_lugre(figure: Figure) -> None:
    """A body that is pulled by a spring sticks and slips."""
    p = {"sigma_0": 1e5, "sigma_1": np.sqrt(1e5), "sigma_2": 0.4, "F_c": 1.0, "F_s": 1.5, "v_s": 0.001}
    pulled = sf.Input([0.0, 20.0], [0.0, 2.0], kind="linear")
    path = simulate(lugre(k=2.0), ("forward",), (), 20.0, p, inputs=pulled, solver="stiff")
    ax = figure.subplots()
    ax.plot(path.times, path.states[:, 0], color=FIT_COLOUR, linewidth=2, label="body")
    ax.plot([0.0, 20.0], [0.0, 2.0], color=REFERENCE_COLOUR, linewidth=1, label="end of the spring")
    ax.set_xlabel("t (s)")
    ax.set_ylabel("position (m)")
    ax.legend(frameon=False, fontsize=8)


def draw_magic_formula(figure: Figure) -> None:
    """The curves of 1987 at four loads."""
    axes = figure.subplots(1, 3)
    slip, angle = np.linspace(0, 30, 121), np.linspace(0, 15, 121)
    curves = (
        (longitudinal_force, slip, MAGIC_FORMULA, "slip ratio (%)", "F_x (N)"),
        (lateral_force, angle, MAGIC_FORMULA, "slip angle (degrees)", "F_y (N)"),
        (compute_aligning_moment, angle, ALIGNING_MOMENT, "slip angle (degrees)", "M_z (N m)"),
    )
    with jax.enable_x64(True):
        for ax, (function, x, coefficients, name, label) in zip(axes, curves, strict=True):
            for k, load in enumerate((2.0, 4.0, 6.0, 8.0)):
                force = function(x, load, coefficients)
                ax.plot(x, force, color=LINE_COLOURS[k], linestyle=STYLES[k], label=f"{load:.0f} kN")
            ax.set_xlabel(name)
            ax.set_title(label, fontsize=9)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False, fontsize=8)


PICTURES = {
    "skid-steer": draw_skid_steer,
    "differential-drive": draw_differential_drive,
    "bicycle": draw_bicycle,
    "rolling-body": draw_rolling_body,
    "lugre": draw_lugre,
    "magic-formula": draw_magic_formula,
}
