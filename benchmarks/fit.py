"""The whole fit of the vehicle: `estimate` against SciPy's SLSQP with finite differences."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.integrate
import scipy.optimize

import switchfit as sf
from benchmarks import vehicle
from benchmarks.derivatives import compiled_cost
from benchmarks.report import Report
from benchmarks.timing import ms, take_turns
from switchfit.evaluate import Evaluator, evaluator_of

TARGET = 10.0
SAME_OPTIMUM = 1e-8
TRUTH = np.array([*vehicle.TRUTH, vehicle.MU_TRUTH])


def run(report: Report, quick: bool) -> None:
    """Time all optimisers from the same start and show where they ended."""
    problem = vehicle.with_reference()
    evaluator = evaluator_of(problem)
    results: dict[str, Any] = {}

    def keep(name: str, fit: Callable[[], Any]) -> Callable[[], None]:
        def call() -> None:
            results[name] = fit()

        return call

    integrated = keep("SLSQP, differences of solve_ivp", lambda: slsqp(problem, CostBySciPy(problem), "2-point"))
    cost = compiled_cost(evaluator)
    calls = {
        "estimate()": keep("estimate()", lambda: sf.estimate(problem)),
        "estimate(), new problem": keep("estimate(), new problem", lambda: sf.estimate(_again(problem))),
        "SLSQP, differences of switchfit's cost": keep(
            "SLSQP, differences of switchfit's cost", lambda: slsqp(problem, cost, "2-point")
        ),
        "SLSQP, central differences of switchfit's cost": keep(
            "SLSQP, central differences of switchfit's cost", lambda: slsqp(problem, cost, "3-point")
        ),
        "SLSQP, switchfit's gradient": keep(
            "SLSQP, switchfit's gradient", lambda: slsqp(problem, *_cost_and_gradient(evaluator))
        ),
    }
    timings = take_turns(calls, 5 if quick else 30)
    timings |= take_turns({"SLSQP, differences of solve_ivp": integrated}, 1 if quick else 5, block=1)
    best = min(evaluator(found_theta(result)).cost for result in results.values())
    fastest = timings["estimate(), new problem"].median
    rows = []
    for name, timing in timings.items():
        result = results[name]
        theta = found_theta(result)
        excess = evaluator(theta).cost - best
        iterations, evaluations = (
            (result.iterations, f"{result.evaluations} (J, g, H)")
            if isinstance(result, sf.Estimate)
            else (result.nit, f"{result.calls} J" + (f", {result.njev} g" if result.exact else ""))
        )
        error = float(np.abs(theta - TRUTH).max())
        same = "yes" if excess <= SAME_OPTIMUM else f"no: +{excess:.1e}"
        rows.append(
            (name, ms(timing.median), f"{timing.median / fastest:.2f}", iterations, evaluations, same, f"{error:.1e}")
        )
        report.data[f"fit: {name}"] = {**vars(timing), "iterations": iterations, "excess": excess, "error": error}
    report.section(
        "Whole fit of the vehicle, warm",
        f"From (5, 9, 0.8) to (6, 10, 0.7), stopping at 1e-7 (switchfit) or ftol 1e-14 (SLSQP). J of all is evaluated "
        f"on switchfit's mesh; the same optimum: J within {SAME_OPTIMUM:.0e} of the best. *New problem*: its mesh is "
        "refined again by an adaptive solve, nothing is compiled; the ratio is to this.",
    )
    report.table(("", "median", "ratio", "iterations", "evaluations", "same optimum", "largest error in theta"), rows)
    for name in ("SLSQP, differences of solve_ivp", "SLSQP, differences of switchfit's cost"):
        report.target(f"whole fit: {name} / switchfit", TARGET, timings[name].median / fastest, "x", at_least=True)


def found_theta(result: Any) -> np.ndarray:
    """theta at which an optimiser stopped."""
    return result.theta if isinstance(result, sf.Estimate) else result.x


def _again(problem: sf.Problem) -> sf.Problem:
    return sf.Problem(problem.system, problem.experiments, problem.parameters)


def _cost_and_gradient(evaluator: Evaluator) -> tuple[Callable[[np.ndarray], Any], bool]:
    def function(theta: np.ndarray) -> tuple[float, np.ndarray]:
        found = evaluator(theta, matrix="none")
        return found.cost, found.gradient

    return function, True


def slsqp(problem: sf.Problem, cost: Callable[[np.ndarray], Any], jac: str | bool) -> Any:
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
        options={"ftol": 1e-14, "maxiter": 500},
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
