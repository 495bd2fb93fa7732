"""Figure 3: a reference from the Magic Formula, fitted with the stick-slip model; why not with 16 coefficients."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from switchfit.estimation.local_fit import fit_locally
from switchfit.fit.evaluator import evaluate
from switchfit.models.magic_formula import MAGIC_FORMULA
from switchfit.paper import vehicle
from switchfit.paper.vehicle import BLUE, DARK, LIGHT, PAGE, RED, Figure, Found, Row, Say, conditions, new_figure, tidy
from switchfit.problem.data import Measurements
from switchfit.problem.experiment import Parameter
from switchfit.report.style import MODE_COLOURS
from switchfit.uncertainty.certificate import identifiability

TITLE = "Magic Formula reference (Fig. 3)"
START = (5.0, 10.0, 0.8)
PAPER = {"tau_1": 5.0, "tau_2": 11.7, "mu": 0.676}
SECONDS = np.arange(16.0)
#: Eigenvalues below this part of the largest one are rounding.
ROUNDING = 1e-15
#: Times (s) in which the wheels reach and lose their difference of speed, which the paper does not print.
RAMPS = ((0.6, 0.6), (0.6, 1.5), (0.6, 2.5), (0.6, 3.4), (1.5, 3.4), (3.4, 3.4), (3.4, 0.6))


def compute(quick: bool, folder: Path, say: Say) -> Found:
    """Return the log, both fits of it, and the Hessian in the 16 coefficients at the truth."""
    say("simulating the vehicle on tyres")
    speeds = vehicle.wheel_speeds()
    positions, path = vehicle.log_on_tyres(SECONDS, speeds)
    found: Found = {
        "times": path.times[::5].round(4).tolist(),
        "yaw": path.states[::5, 5].round(5).tolist(),
        "path": vehicle.curve(path).tolist(),
        "samples": positions.tolist(),
        "fits": vehicle.fit_resticks(vehicle.gps_reference(SECONDS, positions), START, positions),
    }
    found["ramps"] = _ramps(say)
    found.update(_coefficients(speeds, say))
    return found


def _ramps(say: Say) -> list[Found]:
    """Return the fits of stick-slip if the wheels follow their command at other rates."""
    lines: list[Found] = []
    for rise, fall in RAMPS:
        say(f"ramp of {rise:g} s up and {fall:g} s down")
        positions, _ = vehicle.log_on_tyres(SECONDS, vehicle.wheel_speeds(rise=rise, fall=fall))
        fit = fit_locally(vehicle.stick_slip(vehicle.gps_reference(SECONDS, positions), START))
        lines.append({"rise": rise, "fall": fall, **vehicle.summary(fit)})
    return lines


def _coefficients(speeds: Any, say: Say) -> Found:
    """Return the Hessian in the 16 coefficients at their true values, each relative to its own value."""
    say("Hessian in the 16 coefficients")
    times = np.linspace(0.0, 15.0, 151)
    exact, _ = vehicle.log_on_tyres(times, speeds)
    parameters = {name: Parameter(value) for name, value in MAGIC_FORMULA.items()}
    problem = vehicle.on_tyres(Measurements(times, exact, vehicle.position), speeds, parameters)
    hessian = evaluate(problem).hessian
    size = np.array([abs(value) or 1.0 for value in MAGIC_FORMULA.values()])
    analysis = identifiability(problem)
    return {
        "eigenvalues": np.linalg.eigvalsh(hessian * np.outer(size, size)).tolist(),
        "scaled_eigenvalues": analysis.eigenvalues.tolist(),
        "undetermined": analysis.undetermined,
        "worst": [direction.summary for direction in analysis.directions],
    }


def draw(found: Found) -> dict[str, Figure]:
    """Draw figure 3: the paths, the yaw rates that explain the second transition, the eigenvalues."""
    figure = new_figure(PAGE, 2.9)
    paths, yaw, spectrum = figure.subplots(1, 3, width_ratios=(1.2, 1.2, 1.0))
    reference, literal, reset = np.array(found["path"]), found["fits"]["continuous"], found["fits"]["reset"]
    paths.plot(*reference.T, "--", color="#888888", linewidth=2.2, label="Magic Formula")
    paths.plot(*np.array(found["samples"]).T, ".", color=DARK, markersize=4, label="at 1 Hz")
    paths.plot(*np.array(literal["path"]).T, "-", color=DARK, linewidth=1.1, label="stick-slip, optimal")
    paths.plot(*np.array(reset["path"]).T, ":", color=RED, linewidth=1.3, label="with reset at re-stick")
    paths.set_aspect("equal", "datalim")
    paths.legend(frameon=False, fontsize=6.5, loc="center left")
    tidy(paths, "X (m)", "Y (m)", letter="(a)")
    yaw.axvspan(*vehicle.COMMANDED, color=MODE_COLOURS[1], linewidth=0, label="turn commanded")
    yaw.plot(found["times"], found["yaw"], "--", color="#888888", linewidth=2.0)
    yaw.plot(literal["times"], literal["yaw"], "-", color=DARK, linewidth=1.1)
    yaw.plot(reset["times"], reset["yaw"], ":", color=RED, linewidth=1.3)
    yaw.set_ylim(-0.02, 0.55)
    yaw.legend(frameon=False, fontsize=6.5, loc="upper left")
    tidy(yaw, "time (s)", "yaw rate (rad/s)", letter="(b)")
    values = np.abs(np.array(found["eigenvalues"]))[::-1]
    determined = int(np.count_nonzero(values > ROUNDING * values[0]))
    rank = np.arange(1, len(values) + 1)
    spectrum.semilogy(rank[:determined], values[:determined], "o", color=BLUE, markersize=4)
    spectrum.semilogy(rank[determined:], values[determined:], "x", color=DARK, markersize=4, label="rounding")
    spectrum.axhline(ROUNDING * values[0], color=LIGHT, linewidth=0.8)
    spectrum.legend(frameon=False, fontsize=6.5)
    tidy(spectrum, "number", "eigenvalue, 16 coefficients", letter="(c)")
    return {"fig3-magic-formula": figure}


def rows(found: Found) -> list[Row]:
    """Return the lines of the table."""
    literal, reset = found["fits"]["continuous"], found["fits"]["reset"]
    ours, other = literal["theta"], reset["theta"]
    values = np.array(found["eigenvalues"])
    return [
        Row(
            "Fig. 3: tau_1 (s)",
            f"{PAPER['tau_1']:g}, the commanded change",
            f"{ours['tau_1']:.2f} (with reset {other['tau_1']:.2f})",
            f"commanded at 5 s, the wheels take {vehicle.RISE:g} s to follow",
        ),
        Row(
            "Fig. 3: tau_2 (s)",
            f"{PAPER['tau_2']:g}, later than the commanded 10",
            f"{ours['tau_2']:.2f} (with reset {other['tau_2']:.2f})",
            f"delayed by {ours['tau_2'] - vehicle.COMMANDED[1]:.2f} s instead of 1.7 s: tyres of this stiffness stop "
            f"turning within 0.1 s of the wheels, so the delay is that of the wheels ({vehicle.RISE:g} s)",
        ),
        Row(
            "Fig. 3: mu",
            f"{PAPER['mu']:g}; 0.6 to 0.85 on asphalt",
            f"{ours['mu']:.3f} (with reset {other['mu']:.3f})",
            f"mu of (18) sets the yaw rate, which the treads' difference of speed sets here "
            f"(±{vehicle.DIFFERENTIAL:g} m/s, a choice): 0.253 rad/s / mu",
        ),
        Row(
            "Fig. 3: the reference is tracked well",
            "by eye",
            f"{literal['rms_position_error']:.2f} m rms (with reset {reset['rms_position_error']:.2f} m)",
            "taken literally, (18) keeps turning after it sticks again",
        ),
        *_ramp_rows(found["ramps"]),
        Row("Fig. 3: optimality", "necessary and sufficient conditions", conditions(literal)),
        Row(
            "V-A 1: Hessian in 16 Magic Formula coefficients",
            "ill-conditioned",
            f"eigenvalues {values[-1]:.1e} to below rounding; {found['undetermined']} of 16 combinations undetermined",
            f"positions at 10 Hz without noise, coefficients in units of their values; the identifiability analysis "
            f"(scaled Hessian) says of one that it cannot be seen: {found['worst'][0]}",
        ),
    ]


def _ramp_rows(ramps: list[Found]) -> list[Row]:
    """Return a line for each ramp."""
    theta = [line["theta"] for line in ramps]
    return [
        Row(
            f"Fig. 3: the wheels take {line['rise']:g} s to turn and {line['fall']:g} s to stop turning",
            f"not printed; finds {PAPER['tau_1']:g}, {PAPER['tau_2']:g}, {PAPER['mu']:g}",
            f"{t['tau_1']:.2f}, {t['tau_2']:.2f}, {t['mu']:.3f}",
            "tau_1, tau_2 (s), mu",
        )
        for line, t in zip(ramps, theta, strict=True)
    ]
