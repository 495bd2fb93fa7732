"""J, gradient and (J, gradient, Hessian) of switched models: switchfit beside the libraries that people would use.

Every side has a ladder of tolerances, and takes the loosest at which J, gradient and Hessian are as accurate as
`ACCURACY` asks, measured against a reference; the errors stand beside the times. The reference is switchfit with every
step cut into eight, whose J must agree with SciPy's DOP853 (Radau where stiff) at 1e-13.
"""

from __future__ import annotations

import importlib
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np

from benchmarks import problems
from benchmarks.peers import Functions
from benchmarks.problems import Case
from benchmarks.report import Report
from benchmarks.timing import ms, turns_within
from switchfit.engine.native.program_cache import drop_programs
from switchfit.meshes.evaluator import Evaluator

QUANTITIES = ("cost", "gradient", "hessian")
ACCURACY = (1e-8, 1e-7, 1e-6)
"""Relative errors of J, gradient and Hessian up to which a setting will do; finite differences need only the first."""

AGREEMENT = (1e-6, 1e-5, 1e-4)
"""Relative differences above which two sides do not compute the same thing, and the run stops."""

OF_DIFFERENCES = (1e-6, 1e-2, 2e-1)
"""The same for finite differences."""

REFERENCE_AGREEMENT = 1e-10
LADDER = (1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11)
"""rtol of switchfit; the default is 1e-8."""

HOW = (
    "Warm medians, one core, minima in the JSON file. Every side takes the loosest of its settings whose errors "
    f"(of J, gradient, Hessian, relative) are below {', '.join(f'{error:.0e}' for error in ACCURACY)}; finite "
    "differences only that of J. Ratios are to switchfit: above 1 the other side is slower. *Ready after*: from "
    "nothing but imports to the first (J, gradient, Hessian), compilation or building included, at this setting."
)
SIDES = {
    "vehicle": ("switchfit", "CasADi SX", "CasADi MX", "diffrax", "diffrax reverse", "heyoka", "SciPy"),
    "fishing": ("switchfit", "CasADi SX", "CasADi MX", "diffrax", "heyoka", "SciPy"),
    "chain": ("switchfit", "CasADi SX", "CasADi MX", "diffrax", "heyoka", "SciPy"),
    "stiff": ("switchfit", "diffrax", "SciPy"),
}
STIFF_SIDES = dict.fromkeys(
    ("stiff", "robertson", "hires", "heater", "friction"), ("switchfit", "CasADi CVODES", "SciPy")
)
"""The same for `benchmarks.stiff`."""

MODULES = {
    "CasADi CVODES": "casadi_sundials",
    "CasADi SX": "casadi_shooting",
    "CasADi MX": "casadi_shooting",
    "diffrax": "diffrax_hessian",
    "diffrax reverse": "diffrax_hessian",
    "heyoka": "heyoka_variational",
    "SciPy": "scipy_differences",
}
SLOW_IN_QUICK = {
    ("vehicle", "CasADi SX"),
    ("vehicle", "diffrax reverse"),
    ("fishing", "CasADi SX"),
    ("chain", "CasADi SX"),
    ("chain", "SciPy"),
}
TITLES = {
    "vehicle": "Vehicle: 6 states, 2 switches, 1 parameter",
    "fishing": "Lotka-Volterra fishing: 2 states, 8 switches",
    "chain": "Chain of masses: 20 states, 10 switches, 10 parameters",
    "stiff": "Stiff, van der Pol mu = 1000 then decay: 2 states, 1 switch, 2 parameters",
    "robertson": "Robertson, of which one reaction slows down: 3 states, 1 switch, 3 parameters",
    "hires": "HIRES, light then dark: 8 states, 1 switch, 2 parameters",
    "heater": "Heater with a fast sensor, on then off: 3 states, 1 switch, 3 parameters",
    "friction": "Block with friction regularised at 1e-6 m/s, pushed then sliding: 2 states, 1 switch, 2 parameters",
}


@dataclass(frozen=True)
class Found:
    """A side at the setting it was given: what it computes, its errors, and how long it took from nothing."""

    functions: Functions
    errors: tuple[float, ...]
    ready: float


def run(report: Report, quick: bool) -> None:
    """One table a model; raises if the sides disagree."""
    report.section("Derivatives of switched models, side by side", HOW)
    for name, sides in SIDES.items():
        show(report, name, [side for side in sides if not (quick and (name, side) in SLOW_IN_QUICK)], quick)


def show(report: Report, name: str, sides: list[str], quick: bool) -> None:
    """Choose settings, check, time, and print the table of one model."""
    case = problems.case(name)
    reference = reference_of(case)
    found: dict[str, Found] = {}
    missing: dict[str, str] = {}
    for side in sides:
        try:
            found[side] = chosen(side, case, reference)
        except ImportError as error:
            missing[side] = f"not installed ({error.name})"
    timings = {
        quantity: turns_within(
            {
                side: partial(function, case.model.theta)
                for side, entry in found.items()
                if (function := getattr(entry.functions, quantity)) is not None
            },
            0.3 if quick else 2.0,
        )
        for quantity in QUANTITIES
    }
    rows = []
    for side, entry in found.items():
        times = []
        for quantity in QUANTITIES:
            timing, ours = timings[quantity].get(side), timings[quantity].get("switchfit")
            ratio = f" ({timing.median / ours.median:.2f})" if timing and ours and side != "switchfit" else ""
            times.append(f"{ms(timing.median)}{ratio}" if timing else "")
        errors = [f"{error:.0e}" for error in entry.errors]
        rows.append((side, entry.functions.setting, *times, *errors, f"{entry.ready:.1f} s"))
        report.data[f"peers: {name}: {side}"] = {
            "setting": entry.functions.setting,
            "errors": entry.errors,
            "ready": entry.ready,
            **{quantity: vars(timings[quantity][side]) for quantity in QUANTITIES if side in timings[quantity]},
        }
    if name == "vehicle" and "CasADi SX" in timings["hessian"]:
        ratio = timings["hessian"]["CasADi SX"].median / timings["hessian"]["switchfit"].median
        report.target("(J, g, H) of the vehicle at 1e-8: CasADi SX / switchfit", 4.0, ratio, "x", at_least=True)
    rows += [(side, why, *[""] * 7) for side, why in missing.items()]
    report.note(f"**{TITLES[name]}**")
    header = ("", "setting", "J", "J, gradient", "J, gradient, Hessian")
    report.table((*header, "error of J", "of gradient", "of Hessian", "ready after"), rows)


def reference_of(case: Case) -> tuple[float, np.ndarray, np.ndarray]:
    """J, gradient, Hessian at the model's guess to some 12 digits; raises if SciPy has another J."""
    from benchmarks.peers.scipy_differences import cost_of

    theta = case.model.theta
    fine = Evaluator(case.problem()).divide(8)(theta)
    J = cost_of(case.model, 1e-13, 1e-15)(theta)
    if not abs(fine.cost - J) <= REFERENCE_AGREEMENT * abs(J):
        raise ArithmeticError(f"{case.model.name}: J is {J!r} by solve_ivp and {fine.cost!r} by switchfit")
    return fine.cost, fine.gradient, fine.hessian


def builder(side: str, case: Case) -> tuple[tuple[float, ...], Callable[[float], Functions]]:
    """The ladder of a side, from loose to tight, and what builds it at a setting."""
    if side == "switchfit":
        return LADDER, partial(ours, case)
    module = importlib.import_module(f"benchmarks.peers.{MODULES[side]}")
    build: Callable[..., Functions] = module.build
    if side.startswith("diffrax"):
        way = module.WAYS[1 if side.endswith("reverse") else 0]
        build = partial(build, modes=case.system.modes, pack=case.pack, way=way)
    if module.__name__.endswith("casadi_shooting"):
        build = partial(build, unrolled=side.endswith("SX"))
    return module.LADDER, partial(build, case.model)


def ours(case: Case, rtol: float) -> Functions:
    """switchfit on the mesh that rtol asks for at the model's guess."""
    evaluator = Evaluator(case.problem(rtol=rtol, atol=rtol / 100))

    def gradient(theta: np.ndarray) -> tuple[float, np.ndarray]:
        found = evaluator(theta, matrix="none")
        return found.cost, found.gradient

    def hessian(theta: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        found = evaluator(theta)
        return found.cost, found.gradient, found.hessian

    nodes = len(evaluator.meshes[0].times)
    return Functions(f"rtol {rtol:.0e}, {nodes} nodes", evaluator.cost, gradient, hessian)


def chosen(side: str, case: Case, reference: tuple[Any, ...]) -> Found:
    """A side at the first setting that is accurate enough, or the last; raises if it computes something else."""
    by_differences = side == "SciPy"
    theta = case.model.theta
    ladder, build = builder(side, case)
    with _no_files(side):
        for setting in ladder:
            _forget(side)
            began = time.perf_counter()
            functions = build(setting)
            built = time.perf_counter() - began
            last = setting == ladder[-1]
            if not last and error_of(functions.cost(theta), reference[0]) > ACCURACY[0]:
                continue
            if not (last or by_differences) and error_of(functions.gradient(theta)[1], reference[1]) > ACCURACY[1]:
                continue
            began = time.perf_counter()
            result = functions.hessian(theta)
            ready = built + time.perf_counter() - began
            errors = tuple(error_of(a, b) for a, b in zip(result, reference, strict=True))
            if last or by_differences or errors[2] <= ACCURACY[2]:
                break
    allowed = OF_DIFFERENCES if by_differences else AGREEMENT
    if not all(error <= limit for error, limit in zip(errors, allowed, strict=True)):
        listed = ", ".join(f"{error:.0e}" for error in errors)
        raise ArithmeticError(f"{case.model.name}: {side} ({functions.setting}) is off by {listed} in J, g, H")
    return Found(functions, errors, ready)


def error_of(value: Any, exact: Any) -> float:
    """Largest error, relative to the largest entry."""
    return float(np.max(np.abs(np.subtract(value, exact))) / np.max(np.abs(exact)))


def _forget(side: str) -> None:
    """Let go of what switchfit and heyoka keep in this process of what they compiled."""
    if side == "heyoka":
        from heyoka import llvm_state

        llvm_state.clear_memcache()
    elif side == "switchfit":
        jax.clear_caches()
        drop_programs()


@contextmanager
def _no_files(side: str) -> Iterator[None]:
    """Without what switchfit and heyoka keep in files of what they compiled."""
    if side == "heyoka":
        from heyoka import llvm_state

        enabled = llvm_state.get_diskcache_enabled()
        llvm_state.set_diskcache_enabled(False)
        yield
        llvm_state.set_diskcache_enabled(enabled)
        return
    if side != "switchfit":
        yield
        return
    before = os.environ.get("SWITCHFIT_CACHE")
    os.environ["SWITCHFIT_CACHE"] = "off"
    try:
        yield
    finally:
        del os.environ["SWITCHFIT_CACHE"]
        if before is not None:
            os.environ["SWITCHFIT_CACHE"] = before
