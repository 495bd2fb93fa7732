"""When does a robot leave one surface for another, and with what change?

A robot on three omnidirectional wheels drives over the border between two surfaces. The currents of its two driving
wheels rise, and an overhead camera sees it slow down. Which wheel is on which surface is the mode: neither, wheel 1,
wheel 3, both. How many switches does each crossing have, and when are they? Nine logs. Run it:

    python examples/terrain/terrain.py [--out DIR]
    python examples/terrain/terrain.py --cover 100      # how often the intervals contain the truth, by simulation
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import switchfit as sf

FOLDER = Path(__file__).parent
GREEN = tuple(f"green_table_{k:02d}" for k in (0, 6, 12, 18, 24, 30))
GRAY = tuple(f"table_gray_{k:02d}" for k in (0, 6, 12))
SURFACES = {"neither": (0, 0), "wheel 1": (1, 0), "wheel 3": (0, 1), "both": (1, 1)}
"""Modes: is wheel 1, is wheel 3 on the second surface?"""

BEGIN = 0.7  # s; the robot starts up before
BLOCK = 4  # samples in a mean, 0.12 s: neighbouring samples are correlated
TURN = 10700.0  # ticks of a motor in which the residuals of its current repeat
FRAMES = 30.0  # 1/s, of the camera; the log has 32 samples a second
SHORTEST = 0.25  # s; two means
CHANNELS, UNITS = ("current 1", "current 3", "speed"), ("A", "A", "1")
ROUGH = ("10.49 ± 0.05", "5.70 ± 0.13", "4.03 ± 0.04", "2.31 ± 0.04", "3.34 ± 0.02", "2.26 ± 0.05")
"""Borders (s) of the green logs, by an earlier fit of two constant levels that was made without this model."""


def read_samples(name):
    """Return times (K,), the sizes of both currents (K, 2) and the share of the commanded speed (K,) of a log.

    For some 0.2 s at a time the motors' readings repeat, positions and all, and every twelfth camera frame is logged
    twice: what repeats is missing (NaN).
    """
    log = sf.read_log(FOLDER / f"{name}.csv", time_unit="s")
    currents = np.column_stack([log["m1cur"], log["m3cur"]])
    currents[repeats(log, "m1pos", "m3pos", "m1cur", "m3cur")] = np.nan
    command = log["xsetspeed"][1]  # m/s, constant
    speed = np.sign(command) * log["dx"] / 1e3 * FRAMES / abs(command)
    speed[repeats(log, "xpos", "ypos", "ang")] = np.nan
    return log.times, currents, speed


def repeats(log, *channels):
    """Return for each sample whether it repeats the one before in all channels (K,)."""
    values = np.column_stack([log[channel] for channel in channels])
    return np.append(False, np.all(np.diff(values, axis=0) == 0, axis=1))


def average(times, values, block):
    """Return means over `block` samples from BEGIN on; NaN where fewer than two of them are known."""
    first = np.searchsorted(times, BEGIN)
    count = (len(times) - first) // block
    kept = slice(first, first + count * block)
    values = values[kept].reshape(count, block, -1)
    known = np.isfinite(values).sum(axis=1)
    means = np.where(known >= 2, np.nansum(values, axis=1) / np.maximum(known, 1), np.nan)
    return times[kept].reshape(count, block).mean(axis=1), means


def read(name, block=BLOCK):
    """Return times (K,) and both currents (A) and the share of the commanded speed, (K, 3), as means."""
    times, currents, speed = read_samples(name)
    return average(times, np.column_stack([currents, speed]), block)


def drive(on):
    """Return the mode with wheels 1 and 3 on the given surfaces (0 or 1): all approach their levels there.

    With one wheel on each surface, the speed is midway.
    """

    def mode(t, x, p):
        speed = p["v"][0] + sum(on) / 2 * (p["v"][1] - p["v"][0])
        levels = jnp.stack([p["I1"][on[0]], p["I3"][on[1]], speed])
        return (levels - x) / jnp.stack([p["lag_I"], p["lag_I"], p["lag_v"]])

    return mode


def level_at_start(p):
    """All wheels on the first surface, long enough."""
    return jnp.stack([p["I1"][0], p["I3"][0], p["v"][0]])


def robot():
    """Return the system: low-passed currents of wheels 1 and 3, and the speed as a share of the commanded one."""
    modes = {name: drive(on) for name, on in SURFACES.items()}
    return sf.HybridSystem(modes, level_at_start, state_names=CHANNELS, state_units=UNITS)


LEVELS = {
    "I1": sf.Parameter([0.5, 0.9], lower=0.0, upper=3.0, unit="A"),
    "I3": sf.Parameter([0.5, 0.9], lower=0.0, upper=3.0, unit="A"),
    "v": sf.Parameter([0.75, 0.35], lower=0.0, upper=1.5, unit="1"),
}
LAGS = {  # the sharp crossings have 0.15 s; were they free, a slow crossing would pass for a slow motor
    "lag_I": sf.Parameter(0.15, unit="s", scale="log", prior=sf.LogNormal(0.15, 0.3)),
    "lag_v": sf.Parameter(0.15, unit="s", scale="log", prior=sf.LogNormal(0.15, 0.3)),
}
FREE_LAGS = {name: sf.Parameter(0.15, lower=0.02, upper=2.0, unit="s", scale="log") for name in LAGS}
SIGMAS = {
    "sigma_1": sf.Parameter(0.1, unit="A", scale="log"),
    "sigma_3": sf.Parameter(0.1, unit="A", scale="log"),
    "sigma_v": sf.Parameter(0.1, unit="1", scale="log"),
}


def make_run(name, sequence=("neither",), times=(), own=(), block=BLOCK):
    """Return the experiment of one log; the parameters in `own` are not shared with other logs."""
    t, y = read(name, block)
    data = sf.Measurements(t, y, sigma=list(SIGMAS), names=CHANNELS, units=UNITS, loss="huber", loss_scale=2.0)
    renamed = {parameter: f"{parameter}_{name}" for parameter in own}
    return sf.Experiment(data, sequence, times, t0=BEGIN, tf=t[-1], name=name, parameter_map=renamed)


def make_problem(name, sequence=("neither",), times=(), lags=LAGS, block=BLOCK):
    """Return the problem of one log."""
    run = make_run(name, sequence, times, block=block)
    return sf.Problem(robot(), run, LEVELS | lags | SIGMAS, min_duration=SHORTEST)


def find(name, max_switches=3, criterion="mbic", **settings):
    """Return the search for the sequence of one log."""
    return sf.find_modes(
        make_problem(name), first="neither", max_switches=max_switches, criterion=criterion, **settings
    )


def find_numbers(name):
    """Return two more searches of one log, which do not stop where further switches no longer pay.

    One tries every sequence with times on a grid, the other looks at the cost alone; `find` leaves out what cannot win.
    """
    return find(name, method="exhaustive"), find(name, criterion="cost", switch_cost=0.0)


def make_joint_problem(shared="surface", schedules=None, names=GREEN):
    """Return the problem of several logs with common lags; speeds and noise are each log's own.

    shared: "surface", one pair of levels a current; "direction", one for each direction of driving; "nothing", one for
    each log. schedules: sequence and times of each log; for a search none.
    """
    own = ["v", *SIGMAS] + (list(LEVELS)[:2] if shared == "nothing" else [])
    runs, parameters = [], dict(LAGS)
    for name in names:
        run = make_run(name, *((schedules or {}).get(name, ())), own=own)
        renamed = dict(run.parameter_map)
        if shared == "direction":
            backward = int(name[-2:]) % 12 == 6  # experiments 06, 18, 30 drive backward
            renamed |= {current: f"{current}_{'backward' if backward else 'forward'}" for current in ("I1", "I3")}
        runs.append(replace(run, parameter_map=renamed))
        for parameter, guess in (LEVELS | SIGMAS).items():
            parameters[renamed.get(parameter, parameter)] = guess
    return sf.Problem(robot(), runs, parameters, min_duration=SHORTEST)


def six_crossings():
    """Return the problem of the six green logs with common lags and levels of the currents, for `six.toml`."""
    return make_joint_problem()


def crossing():
    """Return the problem of the log at 0.3 m/s, with a guess that is 1.6 s late; `problem.toml` names it."""
    return make_problem("green_table_24", ("neither", "both"), (5.0,))


def stretch(fit):
    """Return by how much correlated residuals widen the intervals of a fit of one log."""
    known = fit.standard_errors > 0
    return float(np.max(fit.corrected_standard_errors[known] / fit.standard_errors[known]))


def intervals(fit, experiment=0):
    """Return 95 % intervals (N, 2) of the transition times of an experiment, widened for correlated residuals."""
    first = sum(len(times) for times in fit.transition_times[:experiment])
    places = slice(first, first + len(fit.transition_times[experiment]))
    naive, corrected = fit.standard_errors[places], fit.corrected_standard_errors[places]
    wider = np.where(
        naive > 0, corrected / np.where(naive > 0, naive, 1.0), stretch(fit)
    )  # a kink has no standard error
    centre = fit.theta[places, None]
    return centre + wider[:, None] * (fit.confidence_intervals(0.95)[places] - centre)


def changes(fit):
    """Return for both currents and the speed of one log: level before, change, half a 95 % interval of the change."""
    found = []
    for name in LEVELS:
        if f"{name}[1]" not in fit.theta_names:
            return ()
        low, high = (fit.theta_names.index(f"{name}[{k}]") for k in (0, 1))
        variance = fit.covariance[low, low] + fit.covariance[high, high] - 2 * fit.covariance[low, high]
        half = 1.96 * stretch(fit) * np.sqrt(variance)
        found.append((fit.theta[low], fit.theta[high] - fit.theta[low], half))
    return tuple(found)


def has_crossed(fit):
    """Return whether the speed and both currents change, by more than 95 % intervals: else it is no other surface."""
    found = changes(fit)
    return bool(found) and all(abs(change) > half for _, change, half in found)


def find_border(name, block=8):
    """Return time (s) of the border, and a 95 % interval, by two constant levels of total current and of the speed.

    Means over 0.25 s; least squares with each channel in units of its residuals; the mean with the border in it has
    both levels in part. No lag, no wheels, no correlation. The interval is where chi-square rises by less than 3.84.
    """
    times, values = read(name, block)
    values = np.column_stack([values[:, 0] + values[:, 1], values[:, 2]])
    kept = np.isfinite(values).all(axis=1)
    times, values = times[kept], values[kept]
    candidates = np.arange(times[1], times[-2], 0.01)
    width = np.median(np.diff(times))
    second = np.clip((times - candidates[:, None]) / width + 0.5, 0.0, 1.0)  # share of each mean on the second level
    misfit = np.empty((len(candidates), 2))
    for k, share in enumerate(second):
        design = np.column_stack([1 - share, share])
        misfit[k] = np.sum((values - design @ np.linalg.lstsq(design, values, rcond=None)[0]) ** 2, axis=0)
    chi_square = misfit
    for _ in range(5):
        best = np.argmin(chi_square.sum(axis=1))
        chi_square = misfit / misfit[best] * (len(times) - 2)
    total = chi_square.sum(axis=1)
    inside = candidates[total < total.min() + 3.84]
    return candidates[best], (inside[0], inside[-1])


def find_partition(name, switches):
    """Return borders (s) by `ruptures`: so many of them, and as many as it finds; None where it is not installed.

    Constant levels of all three channels between the borders, least squares in units of the noise, which the
    differences of neighbors tell. A border of its own choice must lower the sum of squares by 4 log n, for three levels
    and a time. It gives no intervals.
    """
    try:
        import ruptures
    except ImportError:
        return None
    times, values = read(name)
    kept = np.isfinite(values).all(axis=1)
    times, values = times[kept], values[kept]
    noise = np.median(np.abs(np.diff(values, axis=0)), axis=0) / 0.6745 / np.sqrt(2)
    settings = {"model": "l2", "min_size": 2, "jump": 1}
    given = ruptures.Dynp(**settings).fit(values / noise).predict(n_bkps=switches)
    own = ruptures.Pelt(**settings).fit(values / noise).predict(pen=4 * np.log(len(times)))
    return tuple([float(times[k - 1] + times[k]) / 2 for k in ends[:-1]] for ends in (given, own))


def fit_noise(residuals, most=8):
    """Return coefficients and the standard deviation of shocks of autoregressive noise, its order chosen by AIC.

    Residuals that are missing count as zero.
    """
    r = np.nan_to_num(residuals)
    now, before = r[most:], np.column_stack([r[most - k : len(r) - k] for k in range(1, most + 1)])
    found = []
    for order in range(most + 1):
        weights = np.linalg.lstsq(before[:, :order], now, rcond=None)[0] if order else np.zeros(0)
        size = np.std(now - before[:, :order] @ weights)
        found.append((len(now) * np.log(size**2) + 2 * order, weights, size))
    return min(found, key=lambda each: each[0])[1:]


def cover(name, sequence, times, refits, seed=0):
    """Return how often intervals contain the transition times, corrected (N,) and naive (N,), and how wide they are.

    The fit's curves with noise that is as correlated as its residuals, channel by channel, are fitted again `refits`
    times. Widths (s), (N, 2): of the central 95 % of these fits, and the median of their intervals.
    """
    fit = sf.estimate(make_problem(name, sequence, times), strategy="local")
    truth = fit.transition_times[0]
    problem = make_problem(name, sequence, tuple(truth))
    from scipy.signal import lfilter  # takes half a second to import, and a fit does not need it

    (run,), fitted = problem.experiments, fit.comparisons[0][0]
    noise = [fit_noise(column) for column in fitted.residuals.T]
    random = np.random.default_rng(seed)
    found, corrected, naive = [], [], []
    for _ in range(refits):
        shocks = random.standard_normal((3, len(fitted.times) + 200))
        errors = [
            lfilter([size], [1.0, *-weights], row)[200:] for (weights, size), row in zip(noise, shocks, strict=True)
        ]
        values = np.where(np.isfinite(run.data[0].values), fitted.fitted + np.transpose(errors), np.nan)
        again = sf.Problem(
            problem.system,
            replace(run, data=[replace(run.data[0], values=values)]),
            problem.parameters,
            min_duration=SHORTEST,
        )
        refit = sf.estimate(again, strategy="local")
        if refit.status.successful:
            found.append(refit.transition_times[0])
            corrected.append(intervals(refit))
            naive.append(refit.confidence_intervals(0.95)[: len(truth)])
    shares = [
        np.mean([(ends[:, 0] <= truth) & (truth <= ends[:, 1]) for ends in kind], axis=0) for kind in (corrected, naive)
    ]
    spread = np.ptp(np.quantile(found, [0.025, 0.975], axis=0), axis=0)
    return *shares, np.stack([spread, np.median(np.diff(corrected)[..., 0], axis=0)], axis=1)


def describe(name, search):
    """Return the line of the table of one log."""
    best = search.best
    if best is None or not best.transition_times[0].size:
        return f"{name:<15}{search.status.name:<14}no switch"
    parts = []
    for time_, (low, high), mode in zip(
        best.transition_times[0], intervals(best), search.mode_sequence[1:], strict=True
    ):
        parts.append(f"{mode} at {time_:.2f} [{low:.2f}, {high:.2f}]")
    crossed = "" if has_crossed(best) else "; NOT DETERMINED: no change of speed"
    return f"{name:<15}{search.status.name:<14}{best.verdict.level:<9}{'; '.join(parts)}{crossed}"


def vary(name, search):
    """Return the transition times with lags that have no prior, and with means of 2 and of 8 samples."""
    schedule = search.mode_sequence, tuple(search.transition_times[0])
    settings = {"free lags": {"lags": FREE_LAGS}, "means of 2": {"block": 2}, "means of 8": {"block": 8}}
    fits = {
        what: sf.estimate(make_problem(name, *schedule, **given), strategy="local") for what, given in settings.items()
    }
    return {what: fit.transition_times[0] for what, fit in fits.items() if fit.status.successful}


def compare_numbers(*searches, largest=3):
    """Return mBIC of the best with 0, 1, ... switches of searches of one log, less the lowest; NaN without any.

    And the number of switches with the lowest BIC.
    """
    values, fitted = np.full(largest + 1, np.nan), [fit for search in searches for fit in search.fitted]
    for fit in fitted:
        values[fit.switches] = np.fmin(values[fit.switches], fit.mbic)
    return values - np.nanmin(values), min(fitted, key=lambda fit: fit.bic).switches


def plot(searches):
    """Return the figure: the two currents with the fit and the modes of each log."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    figure = Figure(figsize=(9.0, 8.0), layout="constrained")
    shades = {"neither": "none", "wheel 1": "#d9ead3", "wheel 3": "#d9ead3", "both": "#a9d18e"}
    axes = figure.subplots(3, 3).ravel()
    for ax, (name, search) in zip(axes, searches.items(), strict=True):
        fit = search.best
        comparison = fit.comparisons[0][0]
        right = ax.twinx()
        right.plot(comparison.times, comparison.measured[:, 2], ".", color="#999999", markersize=2)
        right.plot(comparison.curve_times, comparison.curve[:, 2], color="#777777", linewidth=1.0)
        right.set_ylim(-1.2, 1.2)
        right.set_yticks([0.0, 0.5, 1.0])
        for k, colour in enumerate(("#2166ac", "#b2182b")):
            ax.plot(comparison.times, comparison.measured[:, k], ".", color=colour, markersize=2)
            ax.plot(comparison.curve_times, comparison.curve[:, k], color=colour, linewidth=1.2)
        edges = [comparison.times[0], *fit.transition_times[0], comparison.times[-1]]
        for mode, begin, end in zip(search.mode_sequence, edges[:-1], edges[1:], strict=True):
            if has_crossed(fit):
                ax.axvspan(begin, end, color=shades[mode], alpha=0.5, linewidth=0)
        for low, high in intervals(fit):
            ax.axvspan(low, high, color="#222222", alpha=0.35, linewidth=0)
        ax.set_xlim(comparison.times[0], comparison.times[-1])
        ax.set_ylim(0.0, 2.6)
        ax.set_yticks([0.0, 0.5, 1.0, 1.5])
        ax.set_zorder(right.get_zorder() + 1)
        ax.patch.set_visible(False)
        ax.set_title(name + ("" if has_crossed(fit) else ": no border"), fontsize="small")
        if ax in axes[6:]:
            ax.set_xlabel("time (s)")
        if ax in axes[::3]:
            ax.set_ylabel("currents 1 and 3 (A)")
        if ax in axes[2::3]:
            right.set_ylabel("speed / commanded")
        else:
            right.set_yticks([])
    marks = {"current 1": "#2166ac", "current 3": "#b2182b", "speed": "#777777", "second surface": "#c0dcb0"}
    handles = [Patch(color=colour, label=what) for what, colour in marks.items()]
    handles.append(Patch(color="#222222", alpha=0.35, label="95 % interval of a switch"))
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize="small", frameon=False)
    return figure


def find_rhythm(name, fit):
    """Return the strongest frequency (Hz) in the residuals of both currents of a log, and ticks of motor 1 in a cycle.

    It is looked for between two transitions, or a transition and an end of the log, where the robot drove the longest.
    """
    times, currents, _ = read_samples(name)
    edges = np.array([BEGIN - 0.6, *fit.transition_times[0], times[-1]])
    longest = np.argmax(np.diff(edges))
    inside = (times > edges[longest] + 0.6) & (times < edges[longest + 1] - 0.2)
    frequencies = np.arange(0.6, 9.0, 0.01)
    power = 0.0
    for current in currents.T:
        kept = inside & np.isfinite(current)
        line = np.polyfit(times[kept], current[kept], 1)
        wave = np.exp(-2j * np.pi * np.outer(frequencies, times[kept]))
        power = power + np.abs(wave @ (current[kept] - np.polyval(line, times[kept]))) ** 2
    found = frequencies[np.argmax(power)]
    ticks = sf.read_log(FOLDER / f"{name}.csv", time_unit="s")["m1pos"][inside]
    return found, abs(ticks[-1] - ticks[0]) / np.ptp(times[inside]) / found


def explain_by_turns(name, fit):
    """Return what the angle of each wheel explains of the residuals of its current: share, correlation before, after.

    Least squares on the means of the sine and cosine of the angle and of twice the angle.
    """
    log = sf.read_log(FOLDER / f"{name}.csv", time_unit="s")
    found = []
    for wheel, channel in ((1, 0), (3, 1)):
        angle = 2 * np.pi * log[f"m{wheel}pos"] / TURN
        waves = [wave(k * angle) for k in (1, 2) for wave in (np.cos, np.sin)]
        _, design = average(log.times, np.column_stack(waves), BLOCK)
        residuals = fit.comparisons[0][0].residuals[:, channel]
        known = np.isfinite(residuals)
        design, before = design[known], residuals[known]
        after = before - design @ np.linalg.lstsq(design, before, rcond=None)[0]
        correlations = [(r[1:] @ r[:-1]) / (r @ r) for r in (before, after)]
        found.append((1 - (after @ after) / (before @ before), *correlations))
    return found


def find_jointly():
    """Return the search for the sequences of all green logs together."""
    return sf.find_modes(make_joint_problem(), first="neither", max_switches=3, criterion="mbic")


def fit_jointly(shared, search):
    """Return the estimate of the green logs together, with the sequences that a search has found for them."""
    times = (tuple(given) for given in search.transition_times)
    schedules = dict(zip(GREEN, zip(search.mode_sequences, times, strict=True), strict=True))
    return sf.estimate(make_joint_problem(shared, schedules), strategy="local")


def main(folder=None):
    """Search each log, then all green ones; print what was found, and draw it."""
    searches = {name: find(name) for name in (*GREEN, *GRAY)}
    print("Each log alone: status of the search, verdict on the fit, modes that begin and 95 % intervals (s)")
    for name, search in searches.items():
        print(describe(name, search))
    print("\nmBIC above the lowest, with 0, 1, 2, 3 switches; BIC prefers; widening for correlated residuals")
    for name, search in searches.items():
        above, preferred = compare_numbers(search, *find_numbers(name))
        numbers = "".join(f"{value:9.1f}" for value in above)
        print(f"{name:<15}{numbers}   {preferred}   {stretch(search.best):.2f}")
    print("\nLevel before, and change with half of its 95 % interval: current 1 (A), current 3 (A), share of the speed")
    for name, search in searches.items():
        text = "   ".join(f"{level:.2f} {change:+.2f} ± {half:.2f}" for level, change, half in changes(search.best))
        white = ", ".join(channel.name for channel in search.best.residuals.channels if not channel.white)
        print(f"{name:<15}{text}   not white: {white or 'none'}")
    print("\nTwo constant levels of 0.25 s means, and switchfit halfway between the levels (s)")
    for name, search in searches.items():
        best, (low, high) = find_border(name)
        tau, lag = search.best.transition_times[0][0], float(search.best.parameters["lag_I"])
        rough = ROUGH[GREEN.index(name)] if name in GREEN else ""
        print(f"{name:<15}{best:6.2f} [{low:.2f}, {high:.2f}]   {tau + lag * np.log(2):6.2f}   {rough}")
    print("\nConstant levels by ruptures: as many borders (s) as switchfit has found, halfway, and as many as it finds")
    for name, search in searches.items():
        halfway = search.best.transition_times[0] + float(search.best.parameters["lag_I"]) * np.log(2)
        found = find_partition(name, len(halfway))
        if found is None:
            print("  not installed: pip install 'switchfit[bench]'")
            break
        given, own = (", ".join(f"{border:.2f}" for border in borders) for borders in found)
        print(f"{name:<15}{', '.join(f'{border:.2f}' for border in halfway):<14}{given:<14}{own}")
    print("\nOther choices: transition times (s) less those above")
    for name, search in searches.items():
        if has_crossed(search.best):
            moved = {what: times - search.transition_times[0] for what, times in vary(name, search).items()}
            print(
                f"{name:<15}" + "; ".join(f"{what} " + ", ".join(f"{d:+.2f}" for d in m) for what, m in moved.items())
            )
    print("\nStrongest frequency of the residuals of the currents (Hz), ticks of motor 1 in a cycle; what the angle of")
    print("its wheel explains of the residuals of each current, and correlation of neighbours before and after")
    for name, search in searches.items():
        turns = ["{:5.0%}, {:+.2f} -> {:+.2f}".format(*found) for found in explain_by_turns(name, search.best)]
        print("{:<15}{:5.2f} {:6.0f}".format(name, *find_rhythm(name, search.best)), *turns, sep="   ")
    began = time.perf_counter()
    joint = find_jointly()
    print(f"\nA search for all six green sequences, in {time.perf_counter() - began:.0f} s: {joint.message}")
    for e, (name, sequence) in enumerate(zip(GREEN, joint.mode_sequences, strict=True)):
        bounds = ", ".join(f"[{low:.2f}, {high:.2f}]" for low, high in intervals(joint.best, e))
        times = ", ".join(f"{tau:.2f}" for tau in joint.transition_times[e])
        print(f"{name:<15}{' -> '.join(sequence):<32}{times}   {bounds}")
    fits = {shared: fit_jointly(shared, joint) for shared in ("surface", "direction", "nothing")}
    print("\nThe six with one lag; levels of the currents shared by all, by direction of driving, or not at all")
    for shared, fit in fits.items():
        times = ", ".join(f"{tau:.2f}" for times in fit.transition_times for tau in times)
        print(f"{shared:<10}J = {fit.cost:.1f}; {times} s")
    print(sf.compare(list(fits.values()), names=list(fits)))
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        plot(searches).savefig(folder / "terrain.svg")


def study(refits, names=(*GREEN, *GRAY)):
    """Print how often the intervals of each log contain the truth, and how wide they are."""
    print(
        f"{refits} refits of simulated logs: 95 % intervals that contain the time, corrected and naive; in seconds, how"
    )
    print("far apart the middle 95 % of the fitted times are, and how wide the median interval is")
    for name in names:
        search = find(name)
        corrected, naive, widths = cover(name, search.mode_sequence, tuple(search.transition_times[0]), refits)
        for time_, *shares, (spread, width) in zip(search.transition_times[0], corrected, naive, widths, strict=True):
            print("{:<15}{:6.2f}   {:4.0%} {:4.0%}   {:.2f} {:.2f}".format(name, time_, *shares, spread, width))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, help="folder for the figures")
    parser.add_argument("--cover", type=int, metavar="N", help="only study the intervals, with N refits of each log")
    given = parser.parse_args()
    if given.cover:
        study(given.cover)
    else:
        main(given.out)
