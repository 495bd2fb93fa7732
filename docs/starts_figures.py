"""The picture of poor first guesses on the page of figures measured, from the table in docs/measured/starts.md."""

from __future__ import annotations

import re
from pathlib import Path

from matplotlib.figure import Figure

HERE = Path(__file__).parent
COLOURS = {"exact": "#bbbbbb", "local": "#9dbbd8", "auto": "#b2182b"}
NAMES = {
    "exact": "one fit, line search",
    "local": "one fit, trust region (strategy='local')",
    "auto": "sf.estimate (strategy='auto')",
}


def draw(folder: Path) -> None:
    """Write starts.svg."""
    folder.mkdir(exist_ok=True)
    shares = read_shares((HERE / "measured" / "starts.md").read_text(encoding="utf-8"))
    bars(shares).savefig(folder / "starts.svg")


def read_shares(text: str) -> dict[str, dict[str, float]]:
    """Return the share of right answers by problem and method."""
    found: dict[str, dict[str, float]] = {}
    for problem, method, right, count in re.findall(r"^\| ([\w-]+) \| ([\w-]+) \| (\d+) of (\d+) \|", text, re.M):
        found.setdefault(problem, {})[method] = int(right) / int(count)
    return found


def bars(shares: dict[str, dict[str, float]]) -> Figure:
    """Horizontal bars, a group a problem."""
    figure = Figure(figsize=(8.0, 0.42 * len(shares) + 1.0), layout="constrained")
    ax = figure.subplots()
    height = 0.8 / len(COLOURS)
    for k, (method, colour) in enumerate(COLOURS.items()):
        at = [(i, 100 * of[method]) for i, of in enumerate(shares.values()) if method in of]
        places = [i + (k - 1) * height for i, _ in at]
        if at:
            ax.barh(places, [share for _, share in at], height, color=colour, label=NAMES[method])
    ax.set_yticks(range(len(shares)), list(shares))
    ax.invert_yaxis()
    ax.set_xlim(0, 100)
    ax.set_xlabel("right answers (%)")
    ax.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=3, frameon=False, fontsize=8)
    return figure
