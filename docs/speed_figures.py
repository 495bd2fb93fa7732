"""The pictures of the page on speed, from docs/measured/speed.json; the documentation draws them when it is built."""

from __future__ import annotations

import json
import re
from pathlib import Path

from matplotlib.figure import Figure

HERE = Path(__file__).parent
COLOURS = {
    "switchfit": "#b2182b",
    "CasADi SX": "#4a7fb5",
    "CasADi MX": "#9dbbd8",
    "diffrax": "#5c9e5c",
    "heyoka": "#e0a030",
    "SciPy": "#777777",
}
METHODS = {
    "auto": ("machine code (default)", "#b2182b", "-o"),
    "discrete-adjoint": ("backward sweep in JAX", "#5c9e5c", "-D"),
    "forward": ("second order forward in JAX", "#4a7fb5", "--s"),
    "adjoint": ("the paper's equations in JAX", "#777777", ":^"),
}


def draw(folder: Path) -> None:
    """Write peers.svg and growth.svg."""
    results = json.loads((HERE / "measured" / "speed.json").read_text(encoding="utf-8"))
    folder.mkdir(exist_ok=True)
    peers(results).savefig(folder / "peers.svg")
    growth(results).savefig(folder / "growth.svg")


def peers(results: dict) -> Figure:
    """Bars: time of (J, g, H), by model and library."""
    pattern = re.compile(r"peers: (\w+): (.+)")
    times: dict[str, dict[str, float]] = {}
    for key, entry in results.items():
        match = pattern.fullmatch(key)
        if match and match[2] in COLOURS and "hessian" in entry:
            times.setdefault(match[1], {})[match[2]] = 1e3 * entry["hessian"]["median"]
    figure = Figure(figsize=(8.0, 3.4), layout="constrained")
    ax = figure.subplots()
    width = 0.8 / len(COLOURS)
    for k, (library, colour) in enumerate(COLOURS.items()):
        at = [(i, of[library]) for i, of in enumerate(times.values()) if library in of]
        places = [i + (k - (len(COLOURS) - 1) / 2) * width for i, _ in at]
        bars = ax.bar(places, [value for _, value in at], width, color=colour, label=library)
        ax.bar_label(bars, [plain(value) for _, value in at], fontsize=6, padding=1)
    ax.set_yscale("log")
    ax.set_ylabel("J, gradient, Hessian (ms)")
    ax.set_xticks(range(len(times)), list(times))
    ax.margins(y=0.15)
    ax.legend(frameon=False, fontsize=8, ncols=3)
    return figure


def growth(results: dict) -> Figure:
    """Four panels: nodes, states, transitions, parameters."""
    figure = Figure(figsize=(9.0, 2.9), layout="constrained")
    axes = figure.subplots(1, 4, sharey=False)
    nodes = sorted((int(name), entry["minimum"]) for name, entry in results["nodes"].items() if name.isdigit())
    label, colour, style = METHODS["auto"]
    axes[0].plot([n for n, _ in nodes], [1e3 * t for _, t in nodes], style, color=colour, markersize=4)
    axes[0].set_xlabel("nodes")
    for ax, (index, what) in zip(axes[1:], enumerate(("states", "transitions", "parameters")), strict=True):
        found = [
            (tuple(map(int, re.findall(r"\d+", key)))[index], entry)
            for key, entry in results.items()
            if re.fullmatch(rf"{what} \(\d+, \d+, \d+\)", key)
        ]
        for method, (label, colour, style) in METHODS.items():
            line = [(size, 1e3 * entry[method]["minimum"]) for size, entry in found]
            ax.plot(*zip(*line, strict=True), style, color=colour, markersize=4, label=label)
        ax.set_xlabel(what)
    for ax in axes:
        ax.set_xscale("log")
        ax.set_yscale("log")
        sizes = ax.lines[0].get_xdata()
        ax.set_xticks(sizes, [plain(size) for size in sizes], fontsize=8)
        ax.yaxis.set_major_formatter(lambda value, _: plain(value))
        ax.minorticks_off()
    axes[0].set_yticks([2, 5, 10, 20])
    axes[0].minorticks_off()
    axes[0].set_ylabel("Hessian (ms)")
    handles, labels = axes[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4, frameon=False, fontsize=8)
    return figure


def plain(value: float) -> str:
    """Two significant digits without an exponent."""
    return f"{float(f'{value:.2g}'):g}"
