"""When were two heaters switched? Six times recovered from two thermistors, and checked against the log.

Two heaters beside two thermistors were set to new powers six times. The log has these times; the fits below do not
look at them. Three models: the energy balance of textbooks; with sensors that lag; and with heaters whose power
depends on what the other one draws. Run it:

    python examples/heaters/heaters.py [--out DIR]
"""

import argparse
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import switchfit as sf

SETTINGS = ((0, 0), (100, 0), (100, 50), (5, 50), (5, 80), (70, 80), (70, 10))  # % of heaters 1 and 2, in order
MODES = tuple(f"{first}/{second}" for first, second in SETTINGS)
GUESS = (22.0, 85.0, 215.0, 285.0, 415.0, 515.0)  # s, placed 12 to 15 s from the recorded times

KELVIN = 273.15
CAPACITY = 0.004 * 500.0  # J/K, mass times specific heat of a heater
AREA, BETWEEN = 1e-3, 2e-4  # m^2, to the air and to the other heater
RADIATION = 0.9 * 5.67e-8  # W/m^2/K^4, emissivity times Stefan and Boltzmann's constant
BLOCK = 40  # samples; longer than the residuals remember
ROOM = 20.4  # °C, of the radiation only: the thermistors differ by 0.9 K in the cold apparatus


def read():
    """Times (K,), temperatures (K, 2), and the times of the six steps that the log has (6,)."""
    table = np.loadtxt(Path(__file__).with_name("energy_balance_6steps.csv"), delimiter=",", skiprows=1)
    stepped = np.any(np.diff(table[:, 1:3], axis=0) != 0, axis=1)
    return table[:, 0], table[:, 3:5], table[1:, 0][stepped]


def radiated(temperature, other):
    """Net power (W/m^2) from a body to another, both in °C."""
    return RADIATION * ((temperature + KELVIN) ** 4 - (other + KELVIN) ** 4)


def energy_balance(setting):
    """dT/dt of both heaters, whose temperatures the thermistors show at once; power in proportion to the setting."""

    def mode(t, x, p):
        lost = p["U"] * AREA * (x - p["ambient"]) + AREA * radiated(x, p["ambient"])
        across = p["U"] * BETWEEN * (x[1] - x[0]) + BETWEEN * radiated(x[1], x[0])
        power = jnp.stack([p["alpha_1"] * setting[0], p["alpha_2"] * setting[1]])
        return (power - lost + jnp.stack([across, -across])) / CAPACITY

    return mode


def lagging(setting, powers):
    """The same for temperatures above those at rest, with sensors that follow their heaters, and conduction across.

    x: heaters 1 and 2, what stands between them and the sensors if anything does, sensors 1 and 2.
    """

    def mode(t, x, p):
        heaters, *between, sensors = x.reshape(-1, 2)
        lost = p["U"] * AREA * heaters + AREA * radiated(ROOM + heaters, ROOM)
        across = p["G"] * (heaters[1] - heaters[0])
        rates = (powers(setting, p) - lost + jnp.stack([across, -across])) / CAPACITY
        rates = [rates]
        for warmed in between:
            rates.append((heaters - warmed) / p["lag_0"])
            heaters = warmed
        return jnp.concatenate([*rates, (heaters - sensors) / jnp.stack([p["lag_1"], p["lag_2"]])])

    return mode


def proportional(setting, p):
    """Power (W) of both heaters by their own settings."""
    return jnp.stack([p["alpha_1"] * setting[0], p["alpha_2"] * setting[1]])


def one_for_each(setting, p):
    """Power (W) of both heaters, unknown for each pair of settings; none where a heater is off."""
    k = SETTINGS.index(setting)
    return jnp.stack([p["P1"][k - 1] if k > 0 else 0.0, p["P2"][k - 2] if k > 1 else 0.0])


def noise(temperatures):
    """Standard deviation (K) of each thermistor's noise, from second differences of neighbours, without any model."""
    return np.std(np.diff(temperatures, 2, axis=0), axis=0) / np.sqrt(6.0)


def make_problem(model="power", guess=GUESS):
    """The six times and the parameters of a model.

    "balance": the energy balance; "lag": with lagging sensors; "power": with a power for each pair of settings as well;
    "package": with 2 s between heaters and sensors, in addition.
    """
    times, temperatures, _ = read()
    parameters = {"U": sf.Parameter(5.0, lower=0.1, upper=50.0, unit="W/m²/K")}
    alphas = {
        "alpha_1": sf.Parameter(0.008, lower=0.0, upper=0.05, unit="W/%"),
        "alpha_2": sf.Parameter(0.004, lower=0.0, upper=0.05, unit="W/%"),
    }
    if model == "balance":
        parameters |= alphas | {"ambient": sf.Parameter(21.0, lower=10.0, upper=35.0, unit="°C")}
        vector_fields = [energy_balance(setting) for setting in SETTINGS]
        start, names, shown = [sf.Parameter(value) for value in temperatures[0]], ["T1", "T2"], shown_at_once
    else:
        parameters |= {
            "G": sf.Parameter(0.004, lower=0.0, upper=0.1, unit="W/K"),
            "lag_1": sf.Parameter(20.0, lower=1.0, upper=100.0, unit="s"),
            "lag_2": sf.Parameter(20.0, lower=1.0, upper=100.0, unit="s"),
            "rest_1": sf.Parameter(temperatures[0, 0], unit="°C"),
            "rest_2": sf.Parameter(temperatures[0, 1], unit="°C"),
        }
        names, shown = ["heater 1", "heater 2", "sensor 1", "sensor 2"], shown_late
        if model == "package":
            parameters |= {"lag_0": sf.Parameter(2.0, unit="s", fixed=True)}
            names[2:2] = ["package 1", "package 2"]
        start = np.zeros(len(names))  # all at rest, and as long as nothing is on it stays there
        if model == "lag":
            parameters |= alphas
            vector_fields = [lagging(setting, proportional) for setting in SETTINGS]
        else:
            first, second = np.array(SETTINGS, dtype=float).T
            parameters |= {
                "P1": sf.Parameter(0.008 * first[1:], lower=0.0, upper=5.0, unit="W"),
                "P2": sf.Parameter(0.004 * second[2:], lower=0.0, upper=5.0, unit="W"),
            }
            vector_fields = [lagging(setting, one_for_each) for setting in SETTINGS]
    system = sf.HybridSystem(
        dict(zip(MODES, vector_fields, strict=True)),
        initial_state=start,
        state_names=names,
        state_units=("°C" if model == "balance" else "K",) * len(names),
    )
    log = sf.Measurements(times, temperatures, observe=shown, sigma=noise(temperatures), names=("T1", "T2"))
    run = sf.Experiment(log, mode_sequence=MODES, transition_times=guess, t0=0.0, tf=times[-1])
    return sf.Problem(system, run, parameters)


def shown_at_once(t, x, p):
    """Thermistors as warm as the heaters."""
    return x


def shown_late(t, x, p):
    """Thermistors with their own temperatures, each from its own reading at rest."""
    return jnp.stack([p["rest_1"], p["rest_2"]]) + x[-2:]


def starts_of(problem, count=12, away=40.0, seed=1):
    """The guess, and starts whose six times lie anywhere within `away` (s) of it, in order."""
    starts = np.tile(problem.initial_theta, (count, 1))
    times = np.array(GUESS) + np.random.default_rng(seed).uniform(-away, away, (count - 1, len(GUESS)))
    starts[1:, : len(GUESS)] = np.maximum(np.sort(times, axis=1), np.arange(1.0, len(GUESS) + 1.0))
    return starts


def find_quantiles(study):
    """2.5 and 97.5 % quantiles of the estimates of a bootstrap: (d, 2)."""
    return np.quantile(study.theta[study.success], [0.025, 0.975], axis=0).T


def table(fits, recorded, study):
    """Recorded and estimated times: lines of text. `study` is the bootstrap of the last of the fits."""
    titles = {"balance": "energy balance", "lag": "sensors lag", "power": "lag, powers free"}
    head = "".join(f"   {titles[model]:>26}" for model in fits)
    lines = [f"{'step':<16}recorded{head}   block bootstrap of the last"]
    low, high = find_quantiles(study)[: len(recorded)].T
    for k, time in enumerate(recorded):
        text = f"{MODES[k]:>6} -> {MODES[k + 1]:<8}{time:6.1f}"
        for fit in fits.values():
            tau = fit.transition_times[0][k]
            text += f"   {tau:8.1f} ± {fit.standard_errors[k]:4.1f} ({tau - time:+6.1f})"
        lines.append(f"{text}   ± {study.standard_deviation[k]:4.1f}, 95 %: {low[k]:.1f} to {high[k]:.1f}")
    return lines


def covered(fit, recorded, study):
    """How many of the recorded times are inside 95 % intervals, by the Hessian and by the bootstrap."""
    intervals = {
        "by its Hessian": fit.confidence_intervals(0.95)[: len(recorded)],
        "by the bootstrap": find_quantiles(study)[: len(recorded)],
    }
    return {
        what: int(np.sum((pairs[:, 0] <= recorded) & (recorded <= pairs[:, 1]))) for what, pairs in intervals.items()
    }


def verdict(fit):
    """What the residuals say, in a sentence."""
    channels = fit.residuals.channels
    size = " and ".join(f"{c.rms:.1f}" for c in channels)
    neighbours = " and ".join(f"{c.correlation:.2f}" for c in channels)
    worth = sum(c.effective for c in channels)
    samples = sum(len(c.values) for c in channels)
    white = ", ".join(f"{c.name} {'white' if c.white else 'not white'}" for c in channels)
    return (
        f"J = {fit.cost:.0f} ({samples / 2:.0f} were it noise); residuals of {size} sigma (T1 and T2), correlation of "
        f"neighbours {neighbours}, {white}; {samples} samples worth {worth:.0f}"
    )


def plot(fits, recorded, study=None):
    """The log with the best fit, and how far each model's times are from the recorded ones, as a matplotlib Figure."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 8.5), layout="constrained")
    curves, left, errors = figure.subplots(3, 1, height_ratios=(3, 2, 2))
    colours = {"balance": "#b35806", "lag": "#998ec3", "power": "#2166ac"}
    titles = {"balance": "energy balance", "lag": "sensors lag", "power": "sensors lag, powers free"}
    best = fits["power"]
    comparison = best.comparisons[0][0]
    for k, name in enumerate(comparison.names):
        curves.plot(comparison.times, comparison.measured[:, k], ".", color="#222222", markersize=2.5)
        curves.plot(comparison.curve_times, comparison.curve[:, k], color=colours["power"], linewidth=1.2)
        curves.annotate(name, (590.0, comparison.measured[-1, k] - 4.0), ha="right")
    curves.set_ylabel("temperature (°C)")
    for k, time in enumerate(recorded):
        curves.axvline(time, color="#777777", linewidth=0.8)
        curves.axvline(best.transition_times[0][k], color=colours["power"], linewidth=0.8, linestyle="--")
        curves.annotate(
            MODES[k + 1], (time, 58.0), (6.0, 0.0), textcoords="offset points", fontsize="small",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5},
        )  # fmt: skip
    curves.set_ylim(17.0, 61.0)
    curves.set_title(
        "Thermistors, fit, and heaters' settings in %: recorded steps solid, estimated dashed", fontsize="medium"
    )
    for model in ("balance", "power"):
        comparison = fits[model].comparisons[0][0]
        left.plot(
            comparison.times, comparison.residuals[:, 0], ".", color=colours[model], markersize=2.5, label=titles[model]
        )
    left.set_ylabel("residual of T1 (K)")
    left.legend(fontsize="small", loc="lower left", ncols=2)
    left.set_ylim(-2.2, 1.7)
    left.set_xlabel("time (s)")
    for ax in (curves, left):
        ax.set_xlim(0.0, 600.0)
    for shift, (model, fit) in zip(np.linspace(-0.2, 0.1, len(fits)), fits.items(), strict=True):
        away = fit.transition_times[0] - recorded
        bars = 1.96 * fit.standard_errors[: len(recorded)]
        errors.errorbar(
            np.arange(1, 7) + shift,
            away,
            bars,
            fmt="o",
            markersize=4,
            color=colours[model],
            capsize=2,
            label=titles[model],
        )
    if study is not None:
        bars = 1.96 * study.standard_deviation[: len(recorded)]
        away = best.transition_times[0] - recorded
        errors.errorbar(
            np.arange(1, 7) + 0.24,
            away,
            bars,
            fmt="s",
            markersize=4,
            color="#222222",
            capsize=2,
            label="the same, block bootstrap",
        )
    errors.axhline(0.0, color="#777777", linewidth=0.8)
    errors.set_yscale("symlog", linthresh=10.0)  # linear to 10 s, logarithmic beyond
    errors.set_ylim(-150.0, 30.0)
    errors.set_yticks([-100, -10, -5, 0, 5, 10], ["-100", "-10", "-5", "0", "5", "10"])
    errors.set_yticks([-50, -20, 20], minor=True)
    errors.set_xlabel("step")
    errors.set_ylabel("estimated - recorded (s)")
    errors.legend(fontsize="small", loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4)
    return figure


def main(folder=None):
    """Fit, print what was found, and draw it."""
    _, temperatures, recorded = read()
    print("noise by second differences: {:.3f} and {:.3f} K".format(*noise(temperatures)))
    print(f"guesses {np.abs(GUESS - recorded).min():.0f} to {np.abs(GUESS - recorded).max():.0f} s off\n")
    fits = {model: sf.estimate(make_problem(model)) for model in ("balance", "lag", "power")}
    best = fits["power"]
    study = sf.bootstrap(best, 200, resample="blocks", block=BLOCK)
    print("\n".join(table(fits, recorded, study)), end="\n\n")
    for what, inside in covered(best, recorded, study).items():
        print(f"{inside} of 6 recorded times inside the 95 % intervals of the last model, {what}")
    for model, fit in fits.items():
        print(f"{model}: {verdict(fit)}.")
    print()
    print("Parameters of the last:")
    for name, value, error in list(zip(best.theta_names, best.theta, best.standard_errors, strict=True))[
        len(recorded) :
    ]:
        print(f"  {name:<8}{value:8.4f} ± {error:.4f}")
    print()
    print(best.residuals, end="\n\n")
    problem = make_problem()
    found = sf.multistart(problem, starts_of(problem))
    print(f"{len(found)} starts up to 40 s from the guess:")
    for k in range(found.clusters.max() + 1):
        print(f"  J = {found.cost[found.clusters == k].min():6.0f} from {np.sum(found.clusters == k)} of them")
    package = sf.estimate(make_problem("package"))
    moved = package.transition_times[0] - best.transition_times[0]
    print(
        f"With another 2 s of lag before the sensors J is {package.cost - best.cost:+.1f}, and the times move by "
        f"{', '.join(f'{seconds:+.1f}' for seconds in moved)} s."
    )
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        plot(fits, recorded, study).savefig(folder / "heaters.svg")
        best.plot_residuals().savefig(folder / "residuals.svg")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, help="folder for the figures")
    main(parser.parse_args().out)
