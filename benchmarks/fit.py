"""The whole fit of the vehicle: `estimate` against SciPy's SLSQP with finite differences."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.integrate
import scipy.optimize

import switchfit as sf
from benchmarks import vehicle
from benchmarks.report import Report
from benchmarks.timing import ms, take_turns
from switchfit.meshes.evaluator import Evaluator, evaluator_of

TARGET = 10.0
SAME_OPTIMUM = 1e-8
NEW_PROBLEM = "estimate(), new problem"
SOLVE_IVP = "SLSQP, differences of solve_ivp"
OWN_COST = "SLSQP, differences of switchfit's cost"


FTOL = (1e-8, 1e-10, 1e-12, 1e-14)
STEPS = (None, 1e-6)
MAX_ITERATIONS = 60


def run(report: Report, quick: bool) -> None:
    """Time all optimisers from the same start and show where they ended."""
    problem = vehicle.with_reference()
    evaluator = evaluator_of(problem)
    best = sf.estimate(problem).theta
    lowest = evaluator(best).cost

    def excess(result: Any) -> float:
        return evaluator(found_theta(result)).cost - lowest

    cost = evaluator.cost
    rivals: dict[str, tuple[Any, str | bool]] = {
        SOLVE_IVP: (CostBySciPy(problem), "2-point"),
        OWN_COST: (cost, "2-point"),
        "SLSQP, central differences of switchfit's cost": (cost, "3-point"),
        "SLSQP, switchfit's gradient": (_cost_and_gradient(evaluator), True),
    }
    fits: dict[str, Callable[[], Any]] = {
        "estimate()": lambda: sf.estimate(problem),
        NEW_PROBLEM: lambda: sf.estimate(_again(problem)),
    }
    settings = {}
    for name, (function, jac) in rivals.items():
        settings[name] = _tuned(problem, function, jac, excess)
        fits[name] = partial(slsqp, problem, function, jac, **settings[name])
    results = {name: fit() for name, fit in fits.items()}
    slow = {SOLVE_IVP: fits.pop(SOLVE_IVP)}
    timings = take_turns(fits, 5 if quick else 30) | take_turns(slow, 1 if quick else 5, block=1)

    rows = []
    ours = timings[NEW_PROBLEM].median
    for name, timing in timings.items():
        result, above = results[name], excess(results[name])
        if isinstance(result, sf.Estimate):
            iterations, evaluations, how = result.iterations, f"{result.evaluations} (J, g, H)", "tolerance 1e-7"
        else:
            iterations, evaluations = result.nit, f"{result.calls} J" + (f", {result.njev} g" if result.exact else "")
            how = ", ".join(f"{key} {value:.0e}" for key, value in settings[name].items() if value is not None)
        same = "yes" if abs(above) <= SAME_OPTIMUM else f"no: {above:+.1e}"
        error = float(np.abs(found_theta(result) - best).max())
        rows.append(
            (name, how, ms(timing.median), f"{timing.median / ours:.2f}", iterations, evaluations, same, f"{error:.1e}")
        )
        report.data[f"fit: {name}"] = {**vars(timing), "iterations": iterations, "excess": above, "error": error}
    report.section(
        "Whole fit of the vehicle, warm",
        f"From (5, 9, 0.8) to (6, 10, 0.7). SLSQP has {len(FTOL) * len(STEPS)} settings of ftol and difference step to "
        f"choose from and takes that with the fewest evaluations to J within {SAME_OPTIMUM:.0e} of estimate()'s, "
        "both on switchfit's mesh. *New problem*: its mesh is chosen again by an adaptive solve, nothing is compiled; "
        "ratios are to this. Errors in theta are differences from where estimate() ends.",
    )
    report.table(
        ("", "settings", "median", "ratio", "iterations", "evaluations", "same optimum", "error in theta"), rows
    )
    for name in (SOLVE_IVP, OWN_COST):
        report.target(f"whole fit: {name} / switchfit", TARGET, timings[name].median / ours, "x", at_least=True)


def _tuned(
    problem: sf.Problem, function: Any, jac: str | bool, excess: Callable[[Any], float]
) -> dict[str, float | None]:
    """Settings that reach the optimum with the fewest evaluations; if none does, those that come closest."""
    tried = []
    for ftol in FTOL:
        for eps in STEPS if jac is not True else (None,):
            result = slsqp(problem, function, jac, ftol=ftol, eps=eps)
            above = max(abs(excess(result)), SAME_OPTIMUM)
            tried.append(((above, result.calls), {"ftol": ftol, "eps": eps}))
    return min(tried, key=lambda entry: entry[0])[1]


def found_theta(result: Any) -> np.ndarray:
    """theta at which an optimiser stopped."""
    return result.theta if isinstance(result, sf.Estimate) else result.x


def _again(problem: sf.Problem) -> sf.Problem:
    return sf.Problem(problem.system, problem.experiments, problem.parameters)


def _difference(eps: float | None, jac: str | bool) -> dict[str, float]:
    """The relative difference step as an option of SLSQP, or SciPy's own choice."""
    if eps is None or jac is True:
        return {}
    return {"finite_diff_rel_step": eps}


def _cost_and_gradient(evaluator: Evaluator) -> Callable[[np.ndarray], Any]:
    def function(theta: np.ndarray) -> tuple[float, np.ndarray]:
        found = evaluator(theta, matrix="none")
        return found.cost, found.gradient

    return function


def slsqp(
    problem: sf.Problem, cost: Callable[[np.ndarray], Any], jac: str | bool, ftol: float, eps: float | None
) -> Any:
    """SciPy's SLSQP with the problem's bounds and ordering; with `jac` True `cost` returns the gradient as well."""
    unknowns = problem.unknowns
    calls = 0

    def counted(theta: np.ndarray) -> Any:
        nonlocal calls
        calls += 1
        return cost(theta)

    result = scipy.optimize.minimize(
        counted,
        problem.initial_theta,
        jac=jac,
        method="SLSQP",
        bounds=list(zip(np.maximum(unknowns.lower, -100.0), np.minimum(unknowns.upper, 100.0), strict=True)),
        constraints={
            "type": "ineq",
            "fun": lambda theta: unknowns.A @ theta - unknowns.b,
            "jac": lambda theta: unknowns.A,
        },
        options={"ftol": ftol, "maxiter": MAX_ITERATIONS} | _difference(eps, jac),
    )
    result.calls, result.exact = calls, jac is True
    return result


class CostBySciPy:
    """J of the vehicle by `solve_ivp`, mode by mode, the running cost as a seventh state; the model in plain Python."""

    RTOL, ATOL = 1e-8, 1e-10  # those of switchfit's mesh

    def __init__(self, problem: sf.Problem) -> None:
        signal = problem.experiments[0].data[0].signal
        self.knots = signal.knots.tolist()
        self.coefficients = signal.coefficients

    def __call__(self, theta: np.ndarray) -> float:
        """J at theta; infinite where the transition times are out of order."""
        times = [vehicle.HORIZON[0], theta[0], theta[1], vehicle.HORIZON[1]]
        if any(b < a for a, b in pairwise(times)):
            return math.inf
        y = np.zeros(7)
        for mode, start, end in zip(vehicle.SEQUENCE, times[:-1], times[1:], strict=True):
            if end > start:
                function = self._stick if mode == "stick" else self._slip
                settings = {"args": (theta[2],), "method": "DOP853", "rtol": self.RTOL, "atol": self.ATOL}
                y = scipy.integrate.solve_ivp(function, (start, end), y, **settings).y[:, -1]
        return float(y[6])

    def _cost(self, t: float, y: np.ndarray) -> float:
        k = min(max(bisect_right(self.knots, t) - 1, 0), len(self.knots) - 2)
        s, c = t - self.knots[k], self.coefficients[k]
        r = y[:6] - (c[0] + s * (c[1] + s * (c[2] + s * c[3])))
        return 0.5 * float(r @ r)

    def _stick(self, t: float, y: np.ndarray, mu: float) -> list[float]:
        _, dX, _, dY, angle, turn, _ = y.tolist()
        cos, sin = math.cos(angle), math.sin(angle)
        return [dX, (60.0 * cos - 0.72 * dX) / 80.0, dY, (60.0 * sin - 0.72 * dY) / 80.0, turn, 0.0, self._cost(t, y)]

    def _slip(self, t: float, y: np.ndarray, mu: float) -> list[float]:
        _, dX, _, dY, angle, turn, _ = y.tolist()
        cos, sin = math.cos(angle), math.sin(angle)
        v = -sin * dX + cos * dY
        inertia = 10.0 * (12 * 0.25**2 + 12 * 0.23**2) + 70.0 * (0.89**2 + 0.55**2)
        ddX = (54.0 * cos - 0.92 * dX) / 80.0 + 9.81 * mu * sin * v
        ddY = (54.0 * sin - 0.92 * dY) / 80.0 - 9.81 * mu * cos * v
        ddturn = (12 * 0.23 * 54.0 - 12 * 0.25**2 * 9.81 * 80.0 * mu * turn) / inertia
        return [dX, ddX, dY, ddY, turn, ddturn, self._cost(t, y)]
