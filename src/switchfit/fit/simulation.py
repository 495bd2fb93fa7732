"""The public function `simulate`: the trajectory of an experiment at any theta, to the problem's tolerances."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.engine.choice import engine_of
from switchfit.engine.run import runs_of
from switchfit.fit.trajectory import Trajectory, build_trajectory
from switchfit.meshes.refinement import refine_mesh_of_run
from switchfit.problem.experiment import Experiment, count_times, show_time
from switchfit.problem.problem import Problem
from switchfit.problem.validation.arrays import as_array, as_index
from switchfit.problem.validation.messages import unit_suffix
from switchfit.problem.validation.objects import as_instance


def simulate(
    problem: Problem,
    theta: ArrayLike | None = None,
    *,
    times: ArrayLike | Literal["samples"] | None = None,
    experiment: int = 0,
) -> Trajectory:
    """Integrate the model to the problem's tolerances.

    Parameters
    ----------
    problem : Problem
    theta : (d,) array_like, optional
        In the order of ``problem.theta_names``; the initial guess if left out.
    times : (K,) array_like or "samples", optional
        Times that increase, inside [t0, tf], at which states are returned, as numbers, or as dates where the times of
        the experiment are dates; at a transition it is the state just before it. "samples": the times of the
        Measurements. All nodes of the mesh if left out, each transition twice. The steps that the tolerances need are
        taken whatever these times are.
    experiment : int, optional
        Index of the experiment, from 0.

    Returns
    -------
    Trajectory

    Raises
    ------
    ValueError
        For a theta of the wrong shape or order, times outside [t0, tf] or that do not increase, an experiment that does
        not exist, or a trajectory that cannot be integrated.
    TypeError
        If an argument is of the wrong type.

    See Also
    --------
    Trajectory, predict, evaluate

    Examples
    --------
    >>> problem = heater_problem()

    >>> path = sf.simulate(problem, [2.5, 0.4])
    >>> round(float(path.states.max()), 1)
    15.8
    >>> sf.simulate(problem, [2.5, 0.4], times=[0.0, 2.0, 4.0, 6.0]).states[:, 0].round(1)
    array([ 0. , 13.8,  8.7,  3.9])
    """
    as_instance(problem, "problem", Problem, "an sf.Problem")
    experiment = as_index(experiment, "experiment", len(problem.experiments))
    checked = problem.check_theta(theta)
    asked = None if times is None else _check_times(problem, experiment, checked, times)
    run = runs_of(problem)[experiment]
    mesh = refine_mesh_of_run(run, checked)
    mesh = mesh if asked is None else mesh.insert(asked)
    simulation = engine_of(run, run.build_arguments(mesh), mesh).simulate(*run.vectors(checked), tangents=False)
    found = build_trajectory(problem, experiment, simulation)
    if asked is None:
        return found
    # The first of two nodes at one time; a free tf that rounding has put before the last time is the last node.
    k = np.minimum(np.searchsorted(found.times, asked), len(found.times) - 1)
    segments = np.searchsorted(k, found.segments)
    return replace(found, times=found.times[k], states=found.states[k], modes=found.modes[k], segments=segments)


def read_times(experiment: Experiment, times: ArrayLike) -> FloatArray:
    """Return times that are asked for, numbers or dates, as numbers: (K,).

    Parameters
    ----------
    experiment : Experiment
    times : (K,) array_like

    Raises
    ------
    ValueError
        If they are not finite numbers of shape (K,), or none.
    """
    asked = np.atleast_1d(as_array(count_times(experiment, times), "times"))
    if asked.ndim != 1 or asked.size == 0 or not np.isfinite(asked).all():
        raise ValueError(f"times must be finite numbers of shape (K,); got shape {asked.shape}.")
    return asked


def _check_times(problem: Problem, e: int, theta: FloatArray, times: ArrayLike | Literal["samples"]) -> FloatArray:
    """Return the times at which a simulation is asked for, (K,)."""
    experiment = problem.experiments[e]
    t0, tf = problem.ends_of_modes(theta)[e][[0, -1]].tolist()
    if isinstance(times, str) and times == "samples":
        found = np.unique(np.concatenate([np.zeros(0), *(item.times for item in experiment.measurements)]))
        inside = found[(t0 <= found) & (found <= tf)]
        if not len(inside):
            raise ValueError(f"times='samples' needs Measurements, and experiment {e} has none; give times.")
        return inside
    asked = read_times(experiment, times)
    wrong = np.append(False, np.diff(asked) <= 0) | (asked < t0) | (asked > tf)
    if wrong.any():
        unit = unit_suffix(experiment.time_unit) if experiment.origin is None else ""
        ends = f"[{show_time(experiment, t0)}, {show_time(experiment, tf)}]{unit}"
        first = show_time(experiment, asked[wrong][0])
        raise ValueError(f"times must increase strictly inside [t0, tf] = {ends}; got {first}.")
    return asked
