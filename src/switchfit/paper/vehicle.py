"""The vehicle of Section V and figure 2; its simulated problem, and logs of a vehicle on tyres of the Magic Formula.

Shared by all parts: lines of the table, and the style of figures.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from switchfit.arrays import FloatArray
from switchfit.estimation.estimator import Estimate
from switchfit.estimation.local_fit import fit_locally
from switchfit.fit.trajectory import Trajectory, simulate
from switchfit.models.magic_formula import magic_formula
from switchfit.models.skid_steer import SLIP_FORCES, skid_steer
from switchfit.models.tyre_forces import MAGIC_FORMULA
from switchfit.optimize import Status
from switchfit.problem.data import Data
from switchfit.problem.experiment import Experiment, Parameter
from switchfit.problem.inputs import Input
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem
from switchfit.problem.reference_signals import ReferenceSignal
from switchfit.runtime.presentation import Axes
from switchfit.runtime.presentation import Figure as Figure
from switchfit.uncertainty.certificate import certify

Found = dict[str, Any]
Say = Callable[[str], None]

#: Width of a figure over one and over two columns (inches).
COLUMN, PAGE = 3.5, 7.16

#: Dark, middle and light, so that they differ in gray too; lines also differ in their dashes.
DARK, RED, BLUE, LIGHT = "#222222", "#b2182b", "#4a7fb5", "#b5b5b5"

SYMBOLS = {"tau_1": r"$\tau_1$", "tau_2": r"$\tau_2$", "mu": r"$\mu$"}

#: Length and width of a wheel as drawn (m).
WHEEL = (0.22, 0.08)

#: Heading as drawn (degrees), and length of the longest force (m).
HEADING, LONGEST = 25.0, 0.34

SEQUENCE = ("stick", "slip", "stick")
NAMES = ("tau_1", "tau_2", "mu")

#: Truth and start of the simulated problem, in the order of NAMES (s, s, 1).
TRUTH, START = (6.0, 10.0, 0.7), (5.0, 9.0, 0.8)

#: Horizon (s): the paper samples over 15 s.
HORIZON = 15.0

#: Cut-off (Hz) of the low-pass filter of 1 Hz positions; the paper gives none.
LOWPASS_HZ = 0.3

#: Times (s) of the commands to the wheels of the Magic Formula vehicle to turn and to stop turning, as in the paper.
COMMANDED = (5.0, 10.0)

#: Time (s) in which the wheels reach a commanded difference of speed.
RISE = 0.6

#: Speed (m/s) of the treads on one side above and on the other below the mean while it turns.
DIFFERENTIAL = 0.17

WHEEL_RADIUS = 0.15
Restick = Literal["continuous", "reset"]


class Row(NamedTuple):
    """One line of the table of results."""

    claim: str
    paper: str
    ours: str
    remark: str = ""


def fill_rows(text: str, **values: Any) -> list[Row]:
    """Return the lines of a template: each begins with "* ", and "|" is between its cells; values stand by their names.

    Parameters
    ----------
    text : str
    **values : object
        What stands in braces, as of `str.format`: ``{fit[theta][mu]:.3f}``.
    """
    lines = text.strip().removeprefix("* ").split("\n* ")
    return [Row(*(" ".join(cell.split()).format_map(values) for cell in line.split("|"))) for line in lines]


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure with small type."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def tidy(ax: Axes, xlabel: str, ylabel: str, *, letter: str = "") -> None:
    """Set labels at a size for one column, a thin frame, and the letter of the panel."""
    ax.set_xlabel(xlabel, fontsize=8)
    ax.set_ylabel(ylabel, fontsize=8)
    ax.tick_params(labelsize=7)
    ax.spines[["top", "right"]].set_visible(False)
    if letter:
        ax.set_title(letter, loc="left", fontsize=8)


def conditions(found: Found) -> str:
    """Return the second-order sufficient conditions of one fit, in words."""
    if not found["sufficient"]:
        return "not satisfied"
    return f"satisfied: ‖DJ‖ = {found['gradient_norm']:.0e}, smallest eigenvalue {found['smallest_eigenvalue']:.3g}"


def position(t: Any, x: Any, p: Any) -> Any:
    """Return the position that GPS measures: (X, Y)."""
    return x[jnp.array([0, 2])]


def stick_slip(
    data: Data,
    start: tuple[float, ...] = START,
    *,
    tf: float = HORIZON,
    stick_force: float = 15.0,
    restick: Restick = "continuous",
) -> Problem:
    """Return the estimation problem of equation (18): transition times and mu from `data`; `start` has this order."""
    system = skid_steer(stick_forces=(stick_force,) * 4, restick=restick)
    run = Experiment(data, SEQUENCE[: len(start)], start[:-1], 0.0, tf)
    return Problem(system, run, {"mu": Parameter(start[-1], lower=0.05, upper=2.0, unit="1")})


def simulate_drive(
    theta: tuple[float, float, float] = TRUTH, *, tf: float = HORIZON, step: float = 0.1, **settings: Any
) -> Trajectory:
    """Simulate equation (18) at given transition times and mu, with a node every `step` seconds; the settings are those
    of `stick_slip`.
    """
    times = step * np.arange(round(tf / step) + 1)
    nothing = Measurements(times, np.zeros((len(times), 6)))
    return simulate(stick_slip(nothing, theta, tf=tf, **settings))


def build_simulated_problem() -> Problem:
    """Return the simulated problem of Section V-A 2: the whole state of (18) at TRUTH is the reference signal."""
    path = simulate_drive()
    return stick_slip(ReferenceSignal.from_samples(path.times, path.states))


def wheel_speeds(
    differential: float = DIFFERENTIAL, stick_force: float = 15.0, *, rise: float = RISE, fall: float = RISE
) -> Input:
    """Return wheel speeds of the Magic Formula vehicle (rad/s), which are a choice: the paper does not print its own.

    The mean speed of the treads is the forward speed of (18) with the paper's torques, mu = 0.7 and slip from 5 to 10 s
    (with reset at re-stick, so that it drives straight on). From 5 to 10 s, wheels 1 and 4 are faster by `differential`
    and 2 and 3 slower; the difference rises within `rise` and falls within `fall` (s).
    """
    path = simulate_drive((*COMMANDED, TRUTH[2]), stick_force=stick_force, restick="reset")
    theta = path.states[:, 4]
    forward = np.cos(theta) * path.states[:, 1] + np.sin(theta) * path.states[:, 3]
    knots = [0.0, COMMANDED[0], COMMANDED[0] + rise, COMMANDED[1], COMMANDED[1] + fall, HORIZON]
    times = np.unique(np.concatenate([np.arange(0.0, HORIZON + 0.05, 0.1).round(1), knots]))
    mean = np.interp(times, path.times, forward)
    extra = np.interp(times, knots, [0.0, 0.0, differential, differential, 0.0, 0.0])
    treads = np.stack([mean + extra, mean - extra, mean - extra, mean + extra], axis=1)
    return Input(times, treads / WHEEL_RADIUS, kind="linear")


def on_tyres(data: Data, speeds: Input, parameters: dict[str, Any] | None = None) -> Problem:
    """Return the Magic Formula vehicle under given wheel speeds; `parameters` are its coefficients, by default the
    published ones.
    """
    run = Experiment(data, ("drive",), (), 0.0, HORIZON, inputs=speeds)
    coefficients = dict(MAGIC_FORMULA) if parameters is None else parameters
    return Problem(magic_formula(wheel_radius=WHEEL_RADIUS), run, coefficients, solver="stiff")


def log_on_tyres(times: FloatArray, speeds: Input) -> tuple[FloatArray, Trajectory]:
    """Return positions (K, 2) of the Magic Formula vehicle at `times`, and its trajectory."""
    path = simulate(on_tyres(Measurements(times, np.zeros((len(times), 2)), position), speeds))
    return positions_at(path, times), path


def positions_at(path: Trajectory, times: FloatArray) -> FloatArray:
    """Return positions (K, 2) at times that are nodes of the trajectory."""
    nodes = np.searchsorted(path.times, np.asarray(times) - 1e-9)
    return path.states[nodes][:, [0, 2]]


def curve(path: Trajectory) -> FloatArray:
    """Return positions (K, 2) along a trajectory, a tenth of a second or less apart, for figures."""
    at = np.linspace(path.times[0], path.times[-1], 151)
    return np.stack([np.interp(at, path.times, path.states[:, i]) for i in (0, 2)], axis=1).round(4)


def gps_reference(times: FloatArray, positions: FloatArray) -> ReferenceSignal:
    """Return 1 Hz positions interpolated and low-pass filtered, as in the paper."""
    return ReferenceSignal.from_samples(times, positions, observe=position, lowpass_hz=LOWPASS_HZ, names=("X", "Y"))


def complete(fit: Estimate) -> Estimate:
    """Return the fit itself; raise KeyboardInterrupt if it was stopped before its end."""
    if fit.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    return fit


def fit_log(reference: ReferenceSignal, start: tuple[float, ...], exact: FloatArray, **settings: Any) -> Found:
    """Fit (18) to a log whose exact positions at each second are (K, 2); the settings are those of `stick_slip`."""
    problem = stick_slip(reference, start, **settings)
    fit = fit_locally(problem)
    path = fit.trajectory
    off = positions_at(path, np.arange(float(len(exact)))) - exact
    return {
        **summary(fit),
        "initial": curve(simulate(problem)).tolist(),
        "path": curve(path).tolist(),
        "times": path.times.round(4).tolist(),
        "yaw": path.states[:, 5].round(5).tolist(),
        "rms_position_error": float(np.sqrt(np.mean(np.sum(off**2, axis=1)))),
    }


def summary(fit: Estimate) -> dict[str, Any]:
    """Return the result of a fit, with the second-order sufficient conditions, as plain numbers."""
    smallest = certify(complete(fit), None).smallest_eigenvalue
    return {
        "theta": dict(zip(fit.theta_names, fit.theta.tolist(), strict=True)),
        "cost": fit.cost,
        "gradient_norm": fit.optimality,
        "iterations": fit.iterations,
        "smallest_eigenvalue": smallest,
        "sufficient": bool(fit.status.successful and smallest > 0),
    }


def compute_vehicle(quick: bool, say: Say) -> Found:
    """Return the lengths (m) and the forces in slip (N) of the model."""
    settings = inspect.signature(skid_steer).parameters
    return {name: settings[name].default for name in ("B_l", "B_w", "a", "b")} | {"forces": list(SLIP_FORCES)}


def draw_vehicle(found: Found) -> dict[str, Figure]:
    """Draw the vehicle in slip, turning to the left: wheels with their forces, friction against the lateral speed."""
    from matplotlib.patches import Rectangle
    from matplotlib.transforms import Affine2D

    figure = new_figure(COLUMN, 3.2)
    ax = figure.subplots()
    length, width, a, b = (found[name] for name in ("B_l", "B_w", "a", "b"))
    turn = Affine2D().rotate_deg(HEADING) + ax.transData
    ax.add_patch(Rectangle((-length / 2, -width / 2), length, width, fill=False, edgecolor=DARK, transform=turn))
    places = ((a, -b), (a, b), (-a, b), (-a, -b))  # 1 and 4 on the right, 2 and 3 on the left
    largest = max(found["forces"])
    arrow = {"transform": turn, "length_includes_head": True, "width": 0.008, "head_width": 0.04}
    words: dict[str, Any] = {"fontsize": 6.5, "ha": "center", "transform": turn, "rotation": HEADING}
    for number, ((x, y), force) in enumerate(zip(places, found["forces"], strict=True), start=1):
        corner = x - WHEEL[0] / 2, y - WHEEL[1] / 2
        ax.add_patch(Rectangle(corner, *WHEEL, facecolor=LIGHT, edgecolor=DARK, linewidth=0.7, transform=turn))
        if force > 0:
            ax.arrow(x, y, LONGEST * force / largest, 0.0, color=RED, **arrow)
        friction = 0.07 if x > 0 else 0.14  # the center of mass slides outwards: more at the rear
        ax.arrow(x, y, 0.0, -friction if x > 0 else friction, color=BLUE, **arrow)
        below = -0.09 if x > 0 and y > 0 else 0.1
        label = rf"$F_{number}$ = {force:g} N"
        ax.text(x + (0.05 if x > 0 else -0.05), y - below, label, va="center", **words)
    dash: dict[str, Any] = {"color": DARK, "linewidth": 0.6, "linestyle": "--"}
    ax.plot([0.0, 0.75], [0, 0], transform=turn, **dash)
    ax.plot([0, 0.7], [0, 0], **dash)
    ax.text(0.47, 0.08, r"$\theta$", fontsize=9)
    ax.plot(0, 0, "o", color=DARK, markersize=3)
    ax.plot([], [], color=RED, label="drive forces in slip")
    ax.plot([], [], color=BLUE, label="friction against a turn to the left (slip)")
    ax.set(xlim=(-0.7, 0.85), ylim=(-0.75, 0.62), xlabel="X (m)", ylabel="Y (m)")
    ax.set_aspect("equal")
    ax.tick_params(labelsize=7)
    ax.legend(frameon=False, fontsize=6.5, loc="lower right")
    return {"fig2-vehicle": figure}
