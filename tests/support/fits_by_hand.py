"""Fits made by hand, field by field, for what is printed, drawn and saved of them."""

import itertools
from dataclasses import fields, replace

import numpy as np

import switchfit as sf
from switchfit.fit.comparison import Comparison
from switchfit.fit.result import Fit
from switchfit.fit.trajectory import Trajectory
from switchfit.optimize import IterationRecord, Status
from switchfit.uncertainty.issues import find_issues


def trajectory_of(modes=("stick", "slip", "stick"), times=(0.0, 4.0, 7.0, 10.0), nodes=9) -> Trajectory:
    """States X (m) and dX (m/s) that jump at each transition."""
    t = [np.linspace(a, b, nodes) for a, b in itertools.pairwise(times)]
    states = np.concatenate([np.stack([np.sin(part) + i, np.cos(part)], axis=1) for i, part in enumerate(t)])
    labels = np.repeat(np.array(modes), nodes)
    segments = nodes * np.arange(len(modes) + 1)
    return Trajectory(np.concatenate(t), states, labels, segments, ("X", "dX"), ("m", "m/s"))


def comparison_of(trajectory: Trajectory, samples=30, kind="measurements", sigma=0.1, names=("X", "h")) -> Comparison:
    """Samples of both states, scattered by one sigma in turn up and down; the third sample of X is missing."""
    first, last = trajectory.times[0], trajectory.times[-1]
    times = np.linspace(first, last, samples) if kind == "measurements" else trajectory.times
    fitted = np.stack([np.interp(times, trajectory.times, x) for x in trajectory.states.T], axis=1)
    measured = fitted + 0.1 * (-1.0) ** np.arange(len(times))[:, None]
    if kind == "measurements":
        measured[2, 0] = np.nan
    spread = None if sigma is None else np.full(measured.shape, sigma)
    units = tuple({"X": "m", "dX": "m/s"}.get(name, "") for name in names)
    curve = trajectory.times, trajectory.states
    return Comparison(kind, names, times, measured, fitted, spread, *curve, units=units)


def made(**changes) -> Fit:
    """A fit of one experiment with two free transition times and one parameter; reduced chi-square 1."""
    trajectory = trajectory_of()
    theta = np.array([4.0, 7.0, 0.8])
    hessian = np.array([[400.0, 20.0, 0.0], [20.0, 100.0, 300.0], [0.0, 300.0, 2500.0]])
    fit = Fit(
        theta_names=("tau_1", "tau_2", "mu"),
        theta_units=("s", "s", "1"),
        initial_theta=np.array([3.0, 8.0, 0.5]),
        theta=theta,
        lower=np.array([-np.inf, -np.inf, 0.05]),
        upper=np.array([np.inf, np.inf, 2.0]),
        run_names=("run1",),
        transition_times=(theta[:2].copy(),),
        transition_places=(np.array([0, 1]),),
        final_places=(-1,),
        log_origins=np.zeros(3),
        parameters={"mu": np.array(0.8), "g": np.array(9.81)},
        parameter_units={"mu": "1", "g": "m/s^2"},
        fixed=("g",),
        cost=28.0,
        gradient=np.array([1e-9, -2e-9, 0.0]),
        hessian=hessian,
        optimality=2e-9,
        iterations=2,
        evaluations=4,
        status=Status.CONVERGED,
        history=tuple(
            IterationRecord(k, cost, optimality, 1.0, theta - k, k + 1)
            for k, (cost, optimality) in enumerate([(900.0, 50.0), (30.0, 1e-2), (28.0, 2e-9)])
        ),
        active=(),
        kinks=(),
        free_basis=np.eye(3),
        trajectories=(trajectory,),
        comparisons=((comparison_of(trajectory),),),
        sigma_known=True,
        integration_error=3e-11,
        hessian_kind="exact",
        tolerance=1e-7,
        seconds=1.25,
    )
    return replace(fit, **{"log_origins": np.zeros(len(changes.get("theta", theta)))} | changes)


def several(count: int, names=None) -> Fit:
    """A fit of many experiments with two transitions each, the second one fixed, and one shared parameter."""
    names = names or [f"run{e + 1}" for e in range(count)]
    times = [np.array([3.0 + 0.1 * e, 7.0]) for e in range(count)]
    trajectories = tuple(trajectory_of(times=(0.0, *tau, 10.0)) for tau in times)
    theta = np.array([*(tau[0] for tau in times), 0.8])
    return made(
        theta_names=(*(f"{name}.tau_1" for name in names), "mu"),
        theta_units=("s",) * count + ("1",),
        initial_theta=theta - 0.5,
        theta=theta,
        lower=np.full(count + 1, -np.inf),
        upper=np.full(count + 1, np.inf),
        run_names=tuple(names),
        transition_times=tuple(times),
        transition_places=tuple(np.array([e, -1]) for e in range(count)),
        final_places=(-1,) * count,
        gradient=np.zeros(count + 1),
        hessian=np.diag(np.linspace(100.0, 400.0, count + 1)),
        free_basis=np.eye(count + 1),
        trajectories=trajectories,
        cost=29.0 * count,
        comparisons=tuple((comparison_of(t, names=("X", "dX")),) for t in trajectories),
        history=tuple(IterationRecord(k, 900.0 / (k + 1), 10.0**-k, 1.0, theta, k + 1) for k in range(3)),
    )


def write_report(fit: Fit, certificate=None, **settings) -> str:
    """Return the report of an estimate that has these fields and no model."""
    known = {field.name: getattr(fit, field.name) for field in fields(Fit)}
    return sf.Estimate(**known, saved_certificate=certificate).report(**settings)


def warnings_of(fit: Fit) -> list[str]:
    return [str(issue) for issue in find_issues(fit)]


NOTHING = {
    "status": Status.NONFINITE_START, "cost": np.nan, "gradient": np.full(3, np.nan),
    "hessian": np.full((3, 3), np.nan), "optimality": np.nan, "history": (), "free_basis": np.zeros((3, 0)),
}  # fmt: skip
