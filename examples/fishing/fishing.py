"""When to fish? Optimal control of two populations by a fleet that is out or not, with any number of switches.

The fleet takes fish of both populations, prey and predators, which swing about their equilibrium; what counts is how
far they are from it over twelve time units. The search begins with a fleet that stays in port. Run it:

    python examples/fishing/fishing.py [--out DIR]
"""

import argparse
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import switchfit as sf

HORIZON = 12.0
MOST = 10  # switches
PUBLISHED = 1.345295218  # J with eight switches, from published times


def fleet(out):
    """Prey x[0] and predators x[1], of which a fleet that is out takes 0.4 and 0.2 per unit of time."""

    def field(t, x, p):
        return jnp.stack([x[0] - x[0] * x[1] - 0.4 * out * x[0], x[0] * x[1] - x[1] - 0.2 * out * x[1]])

    return field


SEA = sf.HybridSystem(
    {"idle": fleet(0.0), "fishing": fleet(1.0)}, initial_state=[0.5, 0.7], state_names=("prey", "predators")
)


def deviation(t, x, p):
    """Squared distance from the equilibrium (1, 1)."""
    return (x[0] - 1.0) ** 2 + (x[1] - 1.0) ** 2


def make_problem(**settings):
    """The fleet stays in port; `max_transitions` says that the sequence is to be found."""
    run = sf.Experiment(sf.RunningCost(deviation), ["idle"], [], t0=0.0, tf=HORIZON, time_unit="1")
    return sf.Problem(SEA, run, max_transitions=MOST, **settings)


def find(problem, switch_cost=1e-5):
    """The best schedules by the number of switches; a switch costs so little that all of them pay."""
    return sf.find_modes(problem, max_switches=MOST, switch_cost=switch_cost)


def costs_of(search):
    """J by the number of switches."""
    estimates = search.by_switches
    return {n: estimates[n].cost if n in estimates else fit.cost for fit in search.fitted for n in [fit.switches]}


def choose(costs, switch_cost):
    """The number of switches with the lowest J + switch_cost N."""
    return min(costs, key=lambda n: costs[n] + switch_cost * n)


def table(search):
    """J, and what the last switches have brought, as text."""
    lines, before = ["switches  J             by as much less for a switch"], None
    costs = costs_of(search)
    for n, cost in costs.items():
        gain = "" if before is None else f"{(costs[before] - cost) / (n - before):.2g}"
        lines.append(f"{n:8}  {cost:.9f}  {gain}".rstrip())
        before = n
    return "\n".join(lines)


def plot(search, shown=4):
    """J by the number of switches; a schedule and its populations; where an additional pulse would pay."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    costs, estimate = costs_of(search), search.by_switches[shown]
    rate = sf.insertion(estimate.problem, estimate.theta)
    figure = Figure(figsize=(8.4, 5.6), layout="constrained")
    axes = figure.subplot_mosaic([["costs", "states"], ["costs", "rate"]], width_ratios=(2, 3))

    ax = axes["costs"]
    best = min(costs.values())
    numbers = [n for n in costs if n >= 2]
    for switch_cost, colour in ((0.0, "#222222"), (0.003, "#4a7fb5"), (0.03, "#b2182b")):
        totals = [costs[n] + switch_cost * n for n in numbers]
        label = "J" if switch_cost == 0 else f"J + {switch_cost:g} N"
        ax.plot(numbers, totals, "o-", color=colour, markersize=4, linewidth=1.2, label=label)
        if switch_cost:
            n = choose(costs, switch_cost)
            ax.plot([n], [costs[n] + switch_cost * n], "o", color=colour, markersize=10, fillstyle="none")
    ax.set(xlabel="switches N", ylim=(best - 0.02, None), xlim=(1.5, MOST + 0.5))
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.legend(loc="upper left", frameon=False)

    ax, path = axes["states"], estimate.trajectory
    for k, (name, colour) in enumerate(zip(path.state_names, ("#3b82c4", "#e08a1e"), strict=True)):
        ax.plot(path.times, path.states[:, k], color=colour, label=name)
    ax.axhline(1.0, color="#777777", linewidth=0.8)
    for mode, begin, end in path.mode_spans:
        if mode == "fishing":
            for other in (ax, axes["rate"]):
                other.axvspan(begin, end, color="#ececec", linewidth=0, zorder=0)
    ax.set(xlim=(0, HORIZON), title=f"{shown} switches, the fleet is out in grey", ylabel="population")
    ax.title.set_fontsize("medium")
    ax.legend(loc="upper right", frameon=False)
    ax.tick_params(labelbottom=False)

    ax = axes["rate"]
    for k, (mode, colour) in enumerate(zip(rate.modes, ("#777777", "#b2182b"), strict=True)):
        values = np.where(rate.active == k, np.nan, rate.rate[:, k])
        ax.plot(rate.times, values, color=colour, label=f"pulse of {mode}")
    ax.axhline(0.0, color="#777777", linewidth=0.8)
    ax.set(xlim=(0, HORIZON), xlabel="time", ylabel="dJ / d length of a pulse", ylim=(-0.06, 0.3))
    ax.legend(loc="upper right", frameon=False)
    return figure


def main(out):
    """Print what was found; write the picture."""
    search = find(make_problem(rtol=1e-11, atol=1e-13))
    print(table(search))
    costs = costs_of(search)
    print(f"with 8 switches {costs[8]:.9f}, from published times {PUBLISHED:.9f}")
    for switch_cost in (0.1, 0.03, 0.003, 0.0003):
        n = choose(costs, switch_cost)
        print(f"where a switch costs {switch_cost:g}: {n} switches, J = {costs[n]:.6f}")
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        plot(search).savefig(out / "fishing.svg")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    main(parser.parse_args().out)
