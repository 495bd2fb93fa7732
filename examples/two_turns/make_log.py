"""Write drive.csv and forces.csv: a skid-steered vehicle that turns twice, seen by GPS, and its wheel forces.

The positions are made up: `skid_steer` with the values below, every half second, with noise of 0.1 m (seed 1). It slips
from 5.3 s to 10.4 s and from 15.3 s to 19.5 s, each time some tenths of a second after the forces have changed.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from switchfit.models import skid_steer

TIMES, TRUTH = (5.3, 10.4, 15.3, 19.5), {"mu_f": 0.8, "mu_r": 0.6, "c": 0.72}
END, SIGMA, SEED = 24.0, 0.1, 1
FORCES = np.array(
    [
        [0.0, 15.0, 15.0, 15.0, 15.0],
        [5.0, 27.0, 0.0, 0.0, 27.0],
        [10.0, 15.0, 15.0, 15.0, 15.0],
        [15.0, 0.0, 27.0, 27.0, 0.0],
        [19.0, 15.0, 15.0, 15.0, 15.0],
        [24.0, 15.0, 15.0, 15.0, 15.0],
    ]
)
"""Time (s) and the force of each wheel from then on (N): front right, front left, rear left, rear right."""


def simulate() -> np.ndarray:
    """Return times (s) and positions X, Y (m) with noise, (48, 3)."""
    vehicle = skid_steer(forces_from_input=True, restick="reset", mu_front="mu_f", mu_rear="mu_r", c_1="c")
    times = np.arange(0.5, END + 0.25, 0.5)
    nodes = sf.Measurements(times, np.zeros((len(times), 2)), observe=lambda t, x, p: x[jnp.array([0, 2])])
    forces = sf.Input(FORCES[:, 0], FORCES[:, 1:], kind="hold")
    run = sf.Experiment(nodes, ("stick", "slip", "stick", "slip", "stick"), TIMES, 0.0, END, inputs=forces)
    path = sf.simulate(sf.Problem(vehicle, run, TRUTH))
    clean = path.states[np.searchsorted(path.times, times)][:, [0, 2]]
    return np.column_stack([times, clean + np.random.default_rng(SEED).normal(0.0, SIGMA, clean.shape)])


def write(folder: Path) -> None:
    """Write both logs into a folder."""
    rows = [",".join(f"{value:.3f}" for value in row) for row in simulate()]
    (folder / "drive.csv").write_text("t [s],X [m],Y [m]\n" + "\n".join(rows) + "\n", encoding="utf-8")
    rows = [",".join(f"{value:g}" for value in row) for row in FORCES]
    (folder / "forces.csv").write_text("t [s],F1 [N],F2 [N],F3 [N],F4 [N]\n" + "\n".join(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    write(Path(__file__).parent)
