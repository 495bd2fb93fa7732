"""Write room.csv, the log of the first ten minutes: a room heated for 43 minutes, with noise of 0.1 °C (seed 1)."""

from pathlib import Path

import numpy as np


def make_log(path: Path) -> None:
    """Write a reading every 2 minutes, heated at 0.5 °C/min, cooling at 0.02/min towards 15 °C."""
    minutes = np.arange(0.0, 120.0, 2.0)
    heated = 25.0 * (1.0 - np.exp(-0.02 * np.minimum(minutes, 43.0)))
    temperatures = 15.0 + heated * np.exp(-0.02 * np.maximum(minutes - 43.0, 0.0))
    temperatures += 0.1 * np.random.default_rng(1).normal(size=len(minutes))
    lines = [f"{minute:.0f},{value:.2f}\n" for minute, value in zip(minutes, temperatures, strict=True)]
    path.write_text("time [min],temperature [°C]\n" + "".join(lines), encoding="utf-8")


if __name__ == "__main__":
    make_log(Path(__file__).with_name("room.csv"))
