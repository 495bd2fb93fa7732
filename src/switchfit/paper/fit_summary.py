"""One fit of the paper as plain numbers, with the second-order sufficient conditions."""

from __future__ import annotations

from typing import Any

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.fit.local_fit import fit_locally
from switchfit.fit.result import Fit
from switchfit.fit.simulation import simulate
from switchfit.optimize import Status
from switchfit.paper.table_rows import Found
from switchfit.paper.vehicle import Restick, curve, positions_at, stick_slip
from switchfit.problem.reference_signals import ReferenceSignal
from switchfit.uncertainty.certificate import certify


def conditions(found: Found) -> str:
    """Return the second-order sufficient conditions of one fit, in words."""
    if not found["sufficient"]:
        return "not satisfied"
    return f"satisfied: ‖DJ‖ = {found['gradient_norm']:.0e}, smallest eigenvalue {found['smallest_eigenvalue']:.3g}"


def complete(fit: Fit) -> Fit:
    """Return the fit itself; raise KeyboardInterrupt if it was stopped before its end."""
    if fit.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    return fit


def fit_log(
    reference: ReferenceSignal,
    start: tuple[float, ...],
    exact: FloatArray,
    *,
    stick_force: float = 15.0,
    restick: Restick = "continuous",
) -> Found:
    """Fit (18) to a log whose exact positions at each second are (K, 2)."""
    problem = stick_slip(reference, start, stick_force=stick_force, restick=restick)
    fit = fit_locally(problem)
    path = fit.trajectory
    off = positions_at(path, np.arange(float(len(exact)))) - exact
    return {
        **summary(fit),
        "initial": curve(simulate(problem)).tolist(),
        "path": curve(path).tolist(),
        "times": path.times.round(4).tolist(),
        "yaw": path.states[:, 5].round(5).tolist(),
        "rms_position_error": float(np.sqrt(np.mean(np.sum(off**2, axis=1)))),
    }


def summary(fit: Fit) -> dict[str, Any]:
    """Return the result of a fit, with the second-order sufficient conditions, as plain numbers."""
    # Sufficient for a strict minimum: DJ = 0 and D2J positive definite on the free directions.
    smallest = certify(complete(fit), None).smallest_eigenvalue
    return {
        "theta": dict(zip(fit.theta_names, fit.theta.tolist(), strict=True)),
        "cost": fit.cost,
        "gradient_norm": fit.optimality,
        "iterations": fit.iterations,
        "smallest_eigenvalue": smallest,
        "sufficient": bool(fit.status.successful and smallest > 0),
    }
