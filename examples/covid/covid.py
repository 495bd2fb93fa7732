"""Germany, March 2020: when did the spreading rate of COVID-19 change, and to what?

An SIR model whose spreading rate takes four values; the three dates between them, the four rates, the number of
infected at the start and the weekly rhythm of reporting are fitted to the daily counts. Run it:

    python examples/covid/covid.py [--out DIR]
"""

import argparse
import csv
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import switchfit as sf

POPULATION = 83e6
RECOVERY = 1 / 8  # 1/day, mu
DELAY = 11.0  # days from an infection to its report: all dates move by as much as this does
ADAPTATION = 1.5  # days in which people follow a change; the mean delay of a straight line over three days
ORIGIN = "2020-02-29"  # t = 1.0 is the beginning of 1 March
DAY, NOON = np.timedelta64(24, "h"), np.timedelta64(12, "h")
PUBLISHED = {  # Dehning et al., Science 369 (2020)
    "tau_1": "2020-03-07", "tau_2": "2020-03-16", "tau_3": "2020-03-24",
    "lambda[0]": 0.43, "lambda[1]": 0.25, "lambda[2]": 0.15, "lambda[3]": 0.09,
}  # fmt: skip
LEAST_SQUARES = dict(  # the same SIR, other software
    zip(PUBLISHED, ("2020-03-09", "2020-03-17", "2020-03-24", 0.382, 0.238, 0.171, 0.091), strict=True)
)


def phase(k):
    """SIR while the spreading rate goes to lambda[k]: susceptible, infected, spreading rate."""

    def field(t, x, p):
        new, infected = infections(x), x[1]
        return jnp.stack([-new, new - RECOVERY * infected, (p["lambda"][k] - x[2]) / p["adaptation"]])

    return field


def infections(x):
    """New infections per day."""
    susceptible, infected, rate = x
    return rate * susceptible * infected / POPULATION


def start(p):
    """All are susceptible but exp(log_infected)."""
    infected = jnp.exp(p["log_infected"])
    return jnp.stack([POPULATION - infected, infected, p["lambda"][0]])


def root_of_count(t, x, p):
    """Square root of the count of a day, seen at its noon; the weekly rhythm is that of the day of the report."""
    week = 2 * jnp.pi * (t + DELAY) / 7
    count = infections(x) * jnp.exp(p["week_cos"] * jnp.cos(week) + p["week_sin"] * jnp.sin(week))
    return jnp.sqrt(count)[None]


def make_system(phases=4):
    """A mode for each value of the spreading rate; a search for the number of changes needs more than there were."""
    return sf.HybridSystem(
        modes={f"phase {k}": phase(k) for k in range(phases)},
        initial_state=start,
        state_names=("susceptible", "infected", "rate"),
        state_units=("", "", "1/d"),
    )


GERMANY = make_system()


def read():
    """Days (K,), as dates, and the cases that were new on them (K,): 2 March to 21 April."""
    with Path(__file__).with_name("germany.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    days = np.array([row["date"] for row in rows[1:]], dtype="datetime64[D]")
    return days, np.diff([float(row["cumulative_confirmed"]) for row in rows])


def make_problem(*, until="2020-04-21", adaptation=ADAPTATION):
    """The fit; dates are those on which people are infected, DELAY before they are counted.

    Counts after `until` are left out. Counts per day have dates without a time zone: every day has 24 hours.
    """
    days, counts = read()
    used = np.where(days <= np.datetime64(until), counts, np.nan)
    noon = days + NOON - int(DELAY) * DAY
    latest = np.datetime64(until) - int(DELAY) * DAY - 2 * DAY - NOON
    run = sf.Experiment(
        sf.Measurements(noon, np.sqrt(used), observe=root_of_count, names=("root of count",)),
        mode_sequence=tuple(GERMANY.modes),
        transition_times=[sf.Parameter(PUBLISHED[f"tau_{k}"], lower="2020-02-25", upper=latest) for k in (1, 2, 3)],
        t0=noon[0] - NOON,
        tf=noon[-1] + NOON,
        time_unit="d",
        origin=ORIGIN,
    )
    return sf.Problem(
        GERMANY,
        run,
        {
            "lambda": sf.Parameter([PUBLISHED[f"lambda[{k}]"] for k in range(4)], lower=0.02, upper=0.8, unit="1/d"),
            "log_infected": sf.Parameter(5.0, lower=0.0, upper=10.0),
            "adaptation": sf.Parameter(adaptation, unit="d", fixed=True),
            "week_cos": sf.Parameter(0.0, lower=-1.0, upper=1.0),
            "week_sin": sf.Parameter(0.0, lower=-1.0, upper=1.0),
        },
        min_duration=1.0,
        rtol=1e-7,
        atol=1e-7,
    )


def uncertainties(estimate, runs=400):
    """95 % intervals (6 or more, 2) of dates and rates: by standard errors, profile likelihood, bootstrap of weeks."""
    names = list(PUBLISHED)
    where = [estimate.theta_names.index(name) for name in names]
    profiles = [estimate.profile(name).interval() for name in names]
    study = sf.bootstrap(estimate, runs, resample="blocks", block=7)
    quantiles = np.quantile(study.theta[study.success], [0.025, 0.975], axis=0).T
    return (
        dict(zip(names, estimate.confidence_intervals(0.95)[where], strict=True)),
        dict(zip(names, profiles, strict=True)),
        dict(zip(names, quantiles[where], strict=True)),
    )


def find_dates(estimate, times):
    """Times as dates, for tables and for matplotlib."""
    return estimate.trajectory.origin.to_dates(times, "d")


def date(estimate, *times):
    """Times as days of a month: "7.0 Mar" is the beginning of 7 March."""
    found = find_dates(estimate, times)
    months = {f"{one:%b}" for one in found}
    days = [f"{one.day + one.hour / 24 + one.minute / 1440:.1f}" for one in found]
    if len(months) > 1:
        days = [f"{day} {one:%b}" for day, one in zip(days, found, strict=True)]
    return " to ".join(days) + (f" {months.pop()}" if len(months) == 1 else "")


def table(estimate, intervals):
    """One line for each rate and date, as text."""
    shown = dict(zip(estimate.theta_names, estimate.theta, strict=True))
    header = ("", "estimate", "standard errors", "profile", "bootstrap of weeks", "published", "least squares")
    rows = [header]
    for name in sorted(PUBLISHED):
        is_date = name.startswith("tau")
        others = [there[name] if is_date else f"{there[name]:.3f}" for there in (PUBLISHED, LEAST_SQUARES)]
        ranges = [by[name] for by in intervals]
        if is_date:
            rows.append(
                (
                    f"change {name[-1]}",
                    date(estimate, shown[name]),
                    *(date(estimate, *ends) for ends in ranges),
                    *others,
                )
            )
        else:
            written = [f"{low:.3f} to {high:.3f}" for low, high in ranges]
            rows.append((name, f"{shown[name]:.3f}", *written, *others))
    widths = [max(len(row[k]) for row in rows) for k in range(len(header))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows)


def plot(estimate, dates):
    """Counts with the fit above, the spreading rate below; `dates` are the intervals of tau_1, tau_2, tau_3."""
    from matplotlib.dates import DateFormatter, WeekdayLocator, date2num
    from matplotlib.figure import Figure

    days, counts = read()
    figure = Figure(figsize=(8.0, 6.4), layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=(3, 2))
    times = np.linspace(estimate.trajectory.times[0], estimate.trajectory.times[-1], 400)
    fitted = estimate.predict(times)
    reported, infected = find_dates(estimate, times + DELAY), find_dates(estimate, times)
    for band, shade, what in (
        (fitted.prediction_band(), "#f4d3d3", "95 % of the counts"),
        (fitted.output_band(), "#dd8888", "95 % band of the fit"),
    ):
        low, high = np.maximum(band[:, 0].T, 0.0) ** 2
        above.fill_between(reported, low, high, color=shade, linewidth=0, label=what)
    above.plot(reported, fitted.outputs[:, 0] ** 2, color="#b2182b", label="fitted")
    above.plot(days + NOON, counts, "o", color="#222222", markersize=4, label="new cases")
    above.set(
        ylabel="new cases per day", ylim=(0, None), xlabel=f"day of the report, {DELAY:g} days after the infection"
    )
    above.legend(loc="upper left", frameon=False)

    low, high = fitted.state_band()[:, 2].T
    below.fill_between(infected, low, high, color="#dd8888", linewidth=0)
    below.plot(infected, fitted.states[:, 2], color="#b2182b", label="fitted, with 95 % band")
    noons = [np.datetime64(PUBLISHED[f"tau_{k}"]) + NOON for k in (1, 2, 3)]
    edges = date2num([infected[0], *noons, infected[-1]])
    rates = [PUBLISHED[f"lambda[{k}]"] for k in range(4)]
    below.stairs(rates, edges, baseline=None, color="#4a7fb5", linestyle="--", label="published")
    below.axhline(RECOVERY, color="#777777", linewidth=0.8)
    below.annotate("recovery rate", (infected[0], RECOVERY), (2, 3), textcoords="offset points", color="#777777")
    below.set(ylabel="spreading rate λ (1/day)", ylim=(0, 0.55), xlabel="day of the infection")
    for k, tau in enumerate(estimate.transition_times[0], 1):
        for ax, shift in ((above, DELAY), (below, 0.0)):
            ax.axvline(*find_dates(estimate, [tau + shift]), color="#333333", linewidth=0.8)
            ends = np.array(dates[f"tau_{k}"]) + shift
            ax.axvspan(*find_dates(estimate, ends), color="#333333", alpha=0.1, linewidth=0)
    below.legend(loc="upper right", frameon=False)
    for ax, shown in ((above, reported), (below, infected)):
        ax.set_xlim(shown[0], shown[-1])
        ax.xaxis.set_major_locator(WeekdayLocator(0))
        ax.xaxis.set_major_formatter(DateFormatter("%d %b"))
    return figure


def main(folder=None):
    """Search from many starts, fit, print and draw."""
    search = sf.multistart(make_problem(), 64)
    lowest = np.unique(np.round(np.sort(search.cost[search.success]), 1))[:3]
    print(f"{int(search.success.sum())} of {len(search)} starts converged; the lowest minima: J = {lowest}\n")
    estimate = search.best
    print(estimate, end="\n\n")
    print(estimate.residuals, end="\n\n")
    intervals = uncertainties(estimate)
    print(f"95 % intervals; dates of infections, {DELAY:g} days before their reports\n")
    print(table(estimate, intervals))
    print("\nWhat the dates hang on (estimates, and profile of the third)")
    for what, changed in (
        ("adaptation 1 day", {"adaptation": 1.0}),
        ("adaptation 2 days", {"adaptation": 2.0}),
        ("reports until 9 April", {"until": "2020-04-09"}),
    ):
        other = sf.multistart(make_problem(**changed), 96).best
        dates = ", ".join(date(other, t) for t in other.transition_times[0])
        rate = other.parameters["lambda"][3]
        third = date(other, *other.profile("tau_3").interval())
        print(f"  {what:<22} {dates} ({third}), lambda[3] {rate:.3f}, J = {other.cost:.1f}")
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        figure = plot(estimate, intervals[1])
        figure.savefig(folder / "covid.svg")
        figure.savefig(folder / "covid.png", dpi=120)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="folder for the figure")
    main(parser.parse_args().out)
