"""Figure 3: a reference from the Magic Formula, fitted with the stick-slip model; why not with 16 coefficients."""

from __future__ import annotations

import numpy as np

from switchfit.fit.evaluation import evaluate
from switchfit.fit.local_fit import fit_locally
from switchfit.models.tyre_forces import MAGIC_FORMULA
from switchfit.paper import figure_style, fit_summary, table_rows, tyre_logs, vehicle
from switchfit.paper.figure_style import BLUE, DARK, LIGHT, PAGE, RED, tidy
from switchfit.paper.table_rows import Found, Say, TableRow
from switchfit.paper.tyre_logs import TYRE_LOG_START
from switchfit.paper.vehicle import SAMPLE_TIMES
from switchfit.problem.experiment import Parameter
from switchfit.problem.inputs import Input
from switchfit.problem.measurements import Measurements
from switchfit.report.style import MODE_COLOURS
from switchfit.runtime.presentation import Figure
from switchfit.uncertainty.identification import identifiability

#: Eigenvalues below this part of the largest one are rounding.
EIGENVALUE_ROUNDING = 1e-15

#: Times (s) in which the wheels reach and lose their difference of speed, which the paper does not print.
RAMPS = ((0.6, 0.6), (0.6, 1.5), (0.6, 2.5), (0.6, 3.4), (1.5, 3.4), (3.4, 3.4), (3.4, 0.6))

MAGIC_LINES = """
* Fig. 3: tau_1 (s) | 5, the commanded change | {ours[tau_1]:.2f} (with reset {other[tau_1]:.2f})
| commanded at 5 s, the wheels take {rise:g} s to follow
* Fig. 3: tau_2 (s) | 11.7, later than the commanded 10 | {ours[tau_2]:.2f} (with reset {other[tau_2]:.2f})
| delayed by {delay:.2f} s instead of 1.7 s: tyres of this stiffness stop turning within 0.1 s of the wheels, so the
delay is that of the wheels ({rise:g} s)
* Fig. 3: mu | 0.676; 0.6 to 0.85 on asphalt | {ours[mu]:.3f} (with reset {other[mu]:.3f})
| mu of (18) sets the yaw rate, which the treads' difference of speed sets here (±{differential:g} m/s, a choice): 0.253
rad/s / mu
* Fig. 3: the reference is tracked well | by eye
| {literal[rms_position_error]:.2f} m rms (with reset {reset[rms_position_error]:.2f} m)
| taken literally, (18) keeps turning after it sticks again
"""

RAMP_LINE = """
* Fig. 3: the wheels take {rise:g} s to turn and {fall:g} s to stop turning | not printed; finds 5, 11.7, 0.676
| {theta[tau_1]:.2f}, {theta[tau_2]:.2f}, {theta[mu]:.3f} | tau_1, tau_2 (s), mu
"""

LAST_LINES = """
* Fig. 3: optimality | necessary and sufficient conditions | {conditions}
* V-A 1: Hessian in 16 Magic Formula coefficients | ill-conditioned
| eigenvalues {eigenvalues[15]:.1e} to below rounding; {undetermined} of 16 combinations undetermined
| positions at 10 Hz without noise, coefficients in units of their values; the identifiability analysis (scaled Hessian)
says of one that it cannot be seen: {worst[0]}
"""


def compute_magic(quick: bool, say: Say) -> Found:
    """Return the log, both fits of it, and the Hessian in the 16 coefficients at the truth."""
    say("simulating the vehicle on tyres")
    speeds = tyre_logs.wheel_speeds()
    positions, path = tyre_logs.log_on_tyres(SAMPLE_TIMES, speeds)
    reference = vehicle.gps_reference(SAMPLE_TIMES, positions)
    found: Found = {
        "times": path.times[::5].round(4).tolist(),
        "yaw": path.states[::5, 5].round(5).tolist(),
        "path": vehicle.curve(path).tolist(),
        "samples": positions.tolist(),
        "fits": {
            restick: fit_summary.fit_log(reference, TYRE_LOG_START, positions, restick=restick)
            for restick in ("continuous", "reset")
        },
    }
    found["ramps"] = _ramps(say)
    found.update(_coefficients(speeds, say))
    return found


def _ramps(say: Say) -> list[Found]:
    """Return the fits of stick-slip if the wheels follow their command at other rates."""
    lines: list[Found] = []
    for rise, fall in RAMPS:
        say(f"ramp of {rise:g} s up and {fall:g} s down")
        positions, _ = tyre_logs.log_on_tyres(SAMPLE_TIMES, tyre_logs.wheel_speeds(rise=rise, fall=fall))
        fit = fit_locally(vehicle.stick_slip(vehicle.gps_reference(SAMPLE_TIMES, positions), TYRE_LOG_START))
        lines.append({"rise": rise, "fall": fall, **fit_summary.summary(fit)})
    return lines


def _coefficients(speeds: Input, say: Say) -> Found:
    """Return the Hessian in the 16 coefficients at their true values, each relative to its own value."""
    say("Hessian in the 16 coefficients")
    times = np.linspace(0.0, 15.0, 151)
    exact, _ = tyre_logs.log_on_tyres(times, speeds)
    parameters = {name: Parameter(value) for name, value in MAGIC_FORMULA.items()}
    problem = tyre_logs.on_tyres(Measurements(times, exact, vehicle.position), speeds, parameters)
    hessian = evaluate(problem).hessian
    # H_ij p_i p_j is the Hessian in p / p_true: what a change of each by the same part does. Coefficients that are 0
    # stay as they are.
    size = np.array([abs(value) or 1.0 for value in MAGIC_FORMULA.values()])
    analysis = identifiability(problem)
    return {
        "eigenvalues": np.linalg.eigvalsh(hessian * np.outer(size, size)).tolist(),
        "undetermined": analysis.undetermined,
        "worst": [direction.summary for direction in analysis.directions],
    }


def draw_magic(found: Found) -> dict[str, Figure]:
    """Draw figure 3: the paths, the yaw rates that explain the second transition, the eigenvalues."""
    figure = figure_style.new_figure(PAGE, 2.9)
    paths, yaw, spectrum = figure.subplots(1, 3, width_ratios=(1.2, 1.2, 1.0))
    reference, literal, reset = np.array(found["path"]), found["fits"]["continuous"], found["fits"]["reset"]
    paths.plot(*reference.T, "--", color="#888888", linewidth=2.2, label="Magic Formula")
    paths.plot(*np.array(found["samples"]).T, ".", color=DARK, markersize=4, label="at 1 Hz")
    paths.plot(*np.array(literal["path"]).T, "-", color=DARK, linewidth=1.1, label="stick-slip, optimal")
    paths.plot(*np.array(reset["path"]).T, ":", color=RED, linewidth=1.3, label="with reset at re-stick")
    paths.set_aspect("equal", "datalim")
    paths.legend(frameon=False, fontsize=6.5, loc="center left")
    tidy(paths, "X (m)", "Y (m)", letter="(a)")
    yaw.axvspan(*tyre_logs.COMMANDED, color=MODE_COLOURS[1], linewidth=0, label="turn commanded")
    yaw.plot(found["times"], found["yaw"], "--", color="#888888", linewidth=2.0)
    yaw.plot(literal["times"], literal["yaw"], "-", color=DARK, linewidth=1.1)
    yaw.plot(reset["times"], reset["yaw"], ":", color=RED, linewidth=1.3)
    yaw.set_ylim(-0.02, 0.55)
    yaw.legend(frameon=False, fontsize=6.5, loc="upper left")
    tidy(yaw, "time (s)", "yaw rate (rad/s)", letter="(b)")
    # Eigenvalues ascend, and those that are rounding may be negative.
    values = np.abs(np.array(found["eigenvalues"]))[::-1]
    determined = int(np.count_nonzero(values > EIGENVALUE_ROUNDING * values[0]))
    rank = np.arange(1, len(values) + 1)
    spectrum.semilogy(rank[:determined], values[:determined], "o", color=BLUE, markersize=4)
    spectrum.semilogy(rank[determined:], values[determined:], "x", color=DARK, markersize=4, label="rounding")
    spectrum.axhline(EIGENVALUE_ROUNDING * values[0], color=LIGHT, linewidth=0.8)
    spectrum.legend(frameon=False, fontsize=6.5)
    tidy(spectrum, "number", "eigenvalue, 16 coefficients", letter="(c)")
    return {"fig3-magic-formula": figure}


def list_magic(found: Found) -> list[TableRow]:
    """Return the lines of the table."""
    literal, reset = found["fits"]["continuous"], found["fits"]["reset"]
    ours, other = literal["theta"], reset["theta"]
    fits = {"literal": literal, "reset": reset, "ours": ours, "other": other}
    choices = {"rise": tyre_logs.RISE, "differential": tyre_logs.DIFFERENTIAL}
    return [
        *table_rows.fill_rows(MAGIC_LINES, delay=ours["tau_2"] - tyre_logs.COMMANDED[1], **fits, **choices),
        *(row for ramp in found["ramps"] for row in table_rows.fill_rows(RAMP_LINE, **ramp)),
        *table_rows.fill_rows(LAST_LINES, conditions=fit_summary.conditions(literal), **found),
    ]
