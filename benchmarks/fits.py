"""Whole fits: `estimate` beside IPOPT on a collocation, SLSQP and `least_squares`, from one start and from a hundred.

Where each optimiser stopped is judged by one J: switchfit's on a mesh twice as fine as its default. A fit from a
perturbed start is a success if that J is within `SUCCESS` of the best that any optimiser found from any start, relative
to this best J (to J at the nominal start where the optimum is a perfect fit). Every optimiser gets the same starts and
the same bounds, until its time is up.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

import switchfit as sf
from benchmarks import models, problems, vehicle
from benchmarks.fit import CostBySciPy, _tuned, slsqp
from benchmarks.report import Report
from benchmarks.timing import ms, turns_within
from switchfit.meshes.evaluator import Evaluator

SAME_OPTIMUM, SUCCESS = 1e-8, 1e-6
CLOSE = 1e-2
PERFECT = 1e-6
"""Part of J at the nominal start below which the optimum counts as a perfect fit."""

SCATTER = {"vehicle": np.array([0.5, 0.5, 0.1]), "fishing": np.full(8, 0.1)}
"""Standard deviation of the perturbed starts about the nominal one (about the optimum for fishing)."""

SHORTEST = 0.02
"""Least distance between the switches of a start."""

COLLOCATION_ACCURACY = 1e-8


class Precise(CostBySciPy):
    """The vehicle's cost by `solve_ivp`, accurate enough to be differenced."""

    RTOL, ATOL = 1e-10, 1e-12


@dataclass(frozen=True, eq=False)
class Task:
    """A fit: the nominal start, a hundred others, J by which all are judged, and who fits: ``theta -> theta``."""

    title: str
    start: np.ndarray
    starts: list[np.ndarray]
    judge: Callable[[np.ndarray], float]
    sides: dict[str, Callable[[np.ndarray], np.ndarray]]
    known: float
    missing: tuple[str, ...] = ()
    longest: float = 0.0
    """Seconds of a warm fit that were aimed at; 0 where nothing was."""


def run(report: Report, quick: bool) -> None:
    """Fit, time, count successes; one table a task."""
    count, seconds = (10, 3.0) if quick else (100, 60.0)
    report.section(
        "Whole fits, side by side",
        f"*Warm fit*: median from the nominal start, one core, everything compiled or built; where a ratio is above 1 "
        f"the other side is slower. *J above the best*: relative, from the nominal start, all judged by one J; *same "
        f"optimum* within {SAME_OPTIMUM:.0e}. *Successes*: of the perturbed starts fitted before {seconds:.0f} s were "
        f"over (or all {count}), those that end within {SUCCESS:.0e} of the best J. *A start*: the median fit among "
        "these, whatever has to be compiled for it included.",
    )
    for make in (vehicle_task, fishing_task, tosses_task):
        show(report, make(count, quick), seconds)


def show(report: Report, task: Task, seconds: float) -> None:
    """The table of one task."""
    nominal = {side: fit(task.start) for side, fit in task.sides.items()}
    timings = turns_within(
        {side: partial(fit, task.start) for side, fit in task.sides.items()}, min(seconds / 10, 3.0), rounds=3
    )
    ends = {side: fitted(fit, task, seconds) for side, fit in task.sides.items()}
    judged = {side: [task.judge(theta) for theta, _ in found] for side, found in ends.items()}
    each = {side: float(np.median([taken for _, taken in found])) for side, found in ends.items()}
    at_start = {side: task.judge(theta) for side, theta in nominal.items()}
    best = min([*at_start.values(), *(J for found in judged.values() for J in found)])
    best = best if np.isnan(task.known) else min(best, task.known)
    first = task.judge(task.start)
    scale = abs(best) if abs(best) > PERFECT * first else first
    ours = timings["switchfit"].median
    rows = []
    for side, timing in timings.items():
        above = (at_start[side] - best) / scale
        excesses = [(J - best) / scale for J in judged[side]]
        wins, close = (sum(excess <= limit for excess in excesses) for limit in (SUCCESS, CLOSE))
        same = f"{above:.0e}" if above <= SAME_OPTIMUM else f"{above:.0e}, **not the same**"
        ratio = "" if side == "switchfit" else f"{timing.median / ours:.2f}"
        rows.append((side, ms(timing.median), ratio, same, f"{wins} of {len(excesses)}", close, ms(each[side])))
        report.data[f"fits: {task.title}: {side}"] = {
            **vars(timing),
            "above": above,
            "successes": wins,
            "starts": len(excesses),
            "seconds of a start": each[side],
            "excesses": excesses,
        }
    if task.longest:
        report.target(f"warm fit: {task.title}", 1e3 * task.longest, 1e3 * ours, "ms")
    rows += [(side, "not installed", *[""] * 5) for side in task.missing]
    report.note(f"**{task.title}**")
    report.table(("", "warm fit", "ratio", "J above the best", "successes", f"within {CLOSE:.0%}", "a start"), rows)


def fitted(fit: Callable[[np.ndarray], np.ndarray], task: Task, seconds: float) -> list[tuple[np.ndarray, float]]:
    """Where the fits from the perturbed starts end and what each took (s), as many as there is time for."""
    ends, until = [], time.perf_counter() + seconds
    for start in task.starts:
        began = time.perf_counter()
        if began > until:
            break
        try:
            theta = fit(start)
        except (ValueError, ArithmeticError):  # a start from which the model cannot be integrated: a failure
            theta = start
        ends.append((theta, time.perf_counter() - began))
    return ends


def ordered(theta: np.ndarray, N: int, horizon: tuple[float, float]) -> np.ndarray:
    """theta with its N switches put into order, `SHORTEST` apart and inside the horizon."""
    times = np.sort(np.clip(theta[:N], horizon[0] + SHORTEST, horizon[1] - SHORTEST))
    for i in range(1, N):
        times[i] = max(times[i], times[i - 1] + SHORTEST)
    return np.concatenate([times, theta[N:]])


def scattered(name: str, centre: np.ndarray, count: int) -> list[np.ndarray]:
    """Perturbed starts of a model."""
    model, random = models.MODELS[name], np.random.default_rng(0)
    lower, upper = bounds(model)
    N = len(model.times)
    found = []
    for _ in range(count):
        theta = ordered(centre + SCATTER[name] * random.standard_normal(len(centre)), N, model.horizon)
        theta[N:] = np.clip(theta[N:], lower, upper)
        found.append(theta)
    return found


def bounds(model: models.Model) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the parameters, as in `vehicle.py`."""
    return (np.array([0.05]), np.array([2.0])) if model.p else (np.zeros(0), np.zeros(0))


def vehicle_task(count: int, quick: bool) -> Task:
    """The paper's vehicle with its reference signal, from (5, 9, 0.8) to (6, 10, 0.7)."""
    problem = vehicle.with_reference()
    data, system = problem.experiments[0].data, problem.system
    signal = data[0].signal

    def again(theta: np.ndarray) -> sf.Problem:
        run = sf.Experiment(data, vehicle.SEQUENCE, tuple(theta[:2]), *vehicle.HORIZON)
        return sf.Problem(system, run, {"mu": sf.Parameter(theta[2], lower=0.05, upper=2.0)})

    start = problem.initial_theta
    judge = Evaluator(again(np.array([*vehicle.TRUTH, vehicle.MU_TRUTH]))).divide(2).cost
    by_scipy = Precise(problem)
    sides = {
        "switchfit": lambda theta: sf.estimate(again(theta)).theta,
        "SciPy SLSQP": _slsqp(again, by_scipy, start, judge, quick),
    }
    found = models.VEHICLE
    missing = _with_collocation(sides, found, start, judge, (signal.knots, signal(signal.knots)))
    return Task(
        "Vehicle with a reference signal",
        start,
        scattered("vehicle", start, count),
        judge,
        sides,
        float("nan"),
        missing,
        longest=5e-3,
    )


def fishing_task(count: int, quick: bool) -> Task:
    """Lotka-Volterra fishing from the switches published by SwitchTimeOpt.jl; starts scattered about the optimum."""
    from benchmarks.peers.scipy_differences import cost_of

    case = problems.case("fishing")
    start, best = np.array(models.FISHING_START), np.array(models.FISHING_BEST)
    judge = Evaluator(case.problem(best, rtol=1e-10, atol=1e-12)).cost
    by_scipy = cost_of(case.model, 1e-10)
    sides = {
        "switchfit": lambda theta: sf.estimate(case.problem(theta)).theta,
        "SciPy SLSQP": _slsqp(case.problem, by_scipy, start, judge, quick),
    }
    missing = _with_collocation(sides, case.model, start, judge, None)
    title = "Lotka-Volterra fishing, 8 switches"
    return Task(
        title, start, scattered("fishing", best, count), judge, sides, case.model.optimum, missing, longest=2e-2
    )


def _slsqp(
    again: Callable[[np.ndarray], sf.Problem],
    cost: Any,
    start: np.ndarray,
    judge: Callable[[np.ndarray], float],
    quick: bool,
) -> Callable[[np.ndarray], np.ndarray]:
    """SLSQP with finite differences of `cost`, with the settings that serve it best from the nominal start."""
    settings: dict[str, Any] = {"ftol": 1e-12, "eps": 1e-6}
    if not quick:
        best = judge(sf.estimate(again(start)).theta)
        settings = _tuned(again(start), cost, "2-point", lambda found: judge(found.x) - best)
    return lambda theta: slsqp(again(theta), cost, "2-point", **settings).x


def _with_collocation(
    sides: dict[str, Any],
    model: models.Model,
    start: np.ndarray,
    judge: Callable[[np.ndarray], float],
    reference: tuple[np.ndarray, np.ndarray] | None,
) -> tuple[str, ...]:
    """Add the collocation with the fewest elements whose own J is accurate where it ends; or say that it is missing."""
    try:
        from benchmarks.peers.casadi_collocation import LADDER, Collocation
    except ImportError:
        return ("CasADi collocation, IPOPT",)
    first = judge(start)
    least = PERFECT * first
    for elements in LADDER:
        fit = Collocation(model, elements, bounds(model), reference)
        found = fit(start)
        cost = judge(found.theta)
        scale = first if cost < least else cost
        if abs(found.cost - cost) <= COLLOCATION_ACCURACY * scale:
            break
    sides[f"CasADi collocation, IPOPT ({elements} elements a phase)"] = lambda theta: fit(theta).theta
    return ()


def tosses_task(count: int, quick: bool) -> Task:
    """Ten measured tosses jointly, 51 unknowns."""
    from benchmarks.peers.scipy_fits import Tosses

    measured = problems.read_tosses()
    start = problems.tosses_theta(measured)
    problem = problems.tosses()
    evaluator = Evaluator(problem)
    by_scipy = Tosses(
        [(toss.times, toss.positions) for toss in measured], problem.unknowns.lower, problem.unknowns.upper
    )
    sides = {
        "switchfit": lambda theta: sf.estimate(problems.tosses(theta)).theta,
        "SciPy least_squares": lambda theta: by_scipy(theta).x,
    }

    def judge(theta: np.ndarray) -> float:
        return evaluator(theta, matrix="none").cost

    return Task("Ten tosses jointly, 51 unknowns", start, tosses_starts(count), judge, sides, float("nan"))


def tosses_starts(count: int) -> list[np.ndarray]:
    """Perturbed starts of the tosses: the times anywhere in the later half of each, velocities and friction near."""
    measured = problems.read_tosses()
    start = problems.tosses_theta(measured)
    random = np.random.default_rng(0)
    K = len(measured)
    ends = np.array([toss.times[-1] for toss in measured])
    starts = []
    for _ in range(count):
        theta = start.copy()
        theta[:K] = ends * random.uniform(0.5, 0.9, K)
        theta[K] *= np.exp(0.3 * random.standard_normal())
        states = theta[K + 1 :].reshape(K, 4)
        states[:, :2] += 0.002 * random.standard_normal((K, 2))
        states[:, 2:] *= 1 + 0.1 * random.standard_normal((K, 2))
        starts.append(theta)
    return starts
