"""Which samples tell mu: its standard error over several horizons, and without positions in slip.

The paper says that effectively only four measurements affect it.
"""

from __future__ import annotations

import numpy as np

from switchfit.fit.evaluation import evaluate
from switchfit.paper import vehicle
from switchfit.paper.table_rows import Found
from switchfit.paper.vehicle import HORIZON, TRUTH
from switchfit.problem.measurements import Measurements

#: Standard deviation of positions (m) of which a sample or another may tell mu, and the longest horizon (s) of these.
POSITION_SIGMA, LONGEST_HORIZON = 0.1, 30.0

SAMPLES_LINE = """
* V-A 3: standard error of mu, 1 Hz positions {label} | effectively only four measurements affect it | {mu:.4f}
| {samples} samples, {in_slip} of them in slip; sigma {sigma:g} m
"""


def compare_sample_sets() -> list[Found]:
    """Return the standard error of mu from 1 Hz positions over several horizons, and without positions in slip."""
    path = vehicle.simulate_drive(tf=LONGEST_HORIZON)
    begin, end = TRUTH[:2]
    sets = [(f"0 to {tf:g} s", tf, np.arange(tf + 1)) for tf in (end, 11.0, 12.0, 13.0, HORIZON, 20.0, LONGEST_HORIZON)]
    seconds = np.arange(HORIZON + 1)
    outside = seconds[(seconds <= begin) | (seconds > end)]
    sets.append((f"0 to {HORIZON:g} s without those in slip", HORIZON, outside))
    found: list[Found] = []
    for label, tf, times in sets:
        # A horizon that ends in slip has one transition, and tau_2 is no unknown of it.
        theta = TRUTH if tf > end else (TRUTH[0], TRUTH[2])
        data = Measurements(times, vehicle.positions_at(path, times), vehicle.position, sigma=POSITION_SIGMA)
        hessian = evaluate(vehicle.stick_slip(data, theta, tf=tf)).hessian
        inside = int(np.sum((times > begin) & (times <= end)))
        # At the truth without noise: the residuals are 0, so that D2J is the Fisher information, and needs no fit.
        errors = np.sqrt(np.diag(np.linalg.inv(hessian)))
        found.append({"label": label, "samples": len(times), "in_slip": inside, "mu": float(errors[-1])})
    return found
