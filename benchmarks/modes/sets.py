"""All sets of truths, by name."""

from __future__ import annotations

from benchmarks.modes.hidden import pendulum, two_tanks
from benchmarks.modes.truths import Make, drive, random_modes, three_modes

SETS: dict[str, tuple[Make, int]] = {
    "vehicle, 2 switches, 5 cm": (drive((6.0, 10.0), 0.05), 50),
    "vehicle, 5 switches, 5 cm": (drive((3.0, 5.0, 8.0, 10.0, 13.0), 0.05), 50),
    "vehicle, 5 switches, 0.5 m": (drive((3.0, 5.0, 8.0, 10.0, 13.0), 0.5), 50),
    "three linear modes": (three_modes, 100),
    "random linear modes": (random_modes, 500),
    "two tanks, one level measured": (two_tanks(), 200),
    "two tanks, a mode missing": (two_tanks(lacking=True), 200),
    "pendulum, angle measured": (pendulum(), 200),
    "pendulum, a mode missing": (pendulum(lacking=True), 200),
}
"""Sets of truths, and how many there are in the whole study."""
