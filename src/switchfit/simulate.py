"""Trajectories for people: the forward pass at any theta, as NumPy arrays."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.data import FloatArray
from switchfit.mesh import Mesh
from switchfit.model import Arguments, Model, Structure, float64
from switchfit.problem import Problem
from switchfit.propagate import Path, path_cost, propagate
from switchfit.refine import refined_mesh


@dataclass(frozen=True, eq=False)
class Trajectory:
    """States over time.

    Attributes
    ----------
    times : (K,) array (s)
        All nodes; each transition time stands twice, with the state before and after it.
    states : (K, n) array
    modes : (K,) array of str
        The mode that is active.
    state_names, state_units : tuple of str
    """

    times: FloatArray
    states: FloatArray
    modes: NDArray[np.str_]
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]

    @property
    def mode_spans(self) -> list[tuple[str, float, float]]:
        """Each mode in turn with the times at which it begins and ends."""
        cuts = np.flatnonzero(np.diff(self.times) == 0) + 1
        cuts = cuts[self.times[cuts] == self.times[cuts - 1]]
        edges = [0, *cuts.tolist(), len(self.times)]
        return [
            (str(self.modes[a]), float(self.times[a]), float(self.times[b - 1]))
            for a, b in zip(edges[:-1], edges[1:], strict=True)
        ]


def simulate(problem: Problem, theta: ArrayLike | None = None, *, experiment: int = 0) -> Trajectory:
    """Integrate the model to the problem's tolerances.

    Parameters
    ----------
    problem : Problem
    theta : (d,) array_like, optional
        In the order of ``problem.theta_names``; the initial guess if left out.
    experiment : int, optional
        Which experiment, from 0.

    Returns
    -------
    Trajectory

    Raises
    ------
    ValueError
        For a theta of the wrong shape or order, an experiment that does not exist, or a trajectory that
        cannot be integrated.
    """
    if not 0 <= experiment < len(problem.experiments):
        raise ValueError(f"experiment must lie in 0..{len(problem.experiments) - 1}; got {experiment}.")
    checked = problem.checked_theta(theta)
    return simulated(problem, experiment, checked, refined_mesh(problem, experiment, checked))[1]


def simulated(problem: Problem, e: int, theta: FloatArray, mesh: Mesh) -> tuple[float, Trajectory]:
    """Cost and trajectory of experiment e on a given mesh."""
    structure = problem.structures[e]
    times, parameters = problem.split(theta)
    p = flat_parameters(problem, parameters)
    with float64():
        cost, path = _path(problem.arguments(e, mesh), times[e], p, structure=structure)
    return float(cost), _trajectory(problem, structure, jax.tree.map(np.asarray, path))


def flat_parameters(problem: Problem, parameters: dict[str, FloatArray]) -> FloatArray:
    """The free parameters as the vector p (M,) that the compiled programs take."""
    free = [np.ravel(parameters[name]) for name, q in problem.parameters.items() if not q.fixed]
    return np.concatenate([np.zeros(0), *free])


@partial(jax.jit, static_argnames=("structure",))
def _path(arguments: Arguments, tau: jax.Array, p: jax.Array, *, structure: Structure) -> tuple[jax.Array, Path]:
    model = Model(structure, arguments)
    path = propagate(model, tau, p, jnp.ones(()))
    return path_cost(model, path, p), path


def _trajectory(problem: Problem, structure: Structure, path: Path) -> Trajectory:
    """Ends of all rows that are not padding, and the start of every segment."""
    layout = path.layout
    chunk = layout.start.shape[1]
    times, states, modes = [], [], []
    for i, mode in enumerate(structure.mode_of_segment):
        first, last = layout.first_chunk[i] * chunk, layout.last_row[i] + 1
        start, end = layout.start.reshape(-1)[first:last], layout.end.reshape(-1)[first:last]
        real = end > start
        real[-1] = True
        n = structure.n
        times.append(np.append(start[:1], end[real]))
        states.append(
            np.concatenate([path.before.reshape(-1, n)[first : first + 1], path.after.reshape(-1, n)[first:last][real]])
        )
        modes.append(np.full(len(times[-1]), structure.mode_names[mode]))
    system = problem.system
    names = system.state_names or tuple(f"x{k}" for k in range(structure.n))
    units = system.state_units or ("",) * structure.n
    return Trajectory(np.concatenate(times), np.concatenate(states), np.concatenate(modes), names, units)
