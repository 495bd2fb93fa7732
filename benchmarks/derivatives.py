"""Exact (J, gradient, Hessian) of the vehicle: switchfit against CasADi on the same rows."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import vehicle
from benchmarks.report import Report
from benchmarks.timing import ms, take_turns
from switchfit.engine.native.native_experiment import native_experiment
from switchfit.engine.native.sizes import Order
from switchfit.meshes.evaluator import Evaluator

COARSE = 58
"""Cells of the coarse mesh: with the two rows that the transitions add, 60 rows."""

AGREEMENT = 1e-10
TARGET = 2.5
CONTENDERS = 4
"""Forms of CasADi that are timed on all meshes: the fastest of those timed on the coarse mesh."""

COMPILED = "adjoint SX rows, mapaccum"
"""The form that is also compiled as C: compiling a whole SX graph takes gcc minutes."""


def run(report: Report, quick: bool) -> None:
    """Time both sides on each mesh; raises if they disagree."""
    report.section(
        "Exact J, gradient and Hessian of the vehicle",
        "One core. `call`: theta in, NumPy arrays out. `program`: the compiled program alone, its arguments already in "
        "place (CasADi: through its buffers). `in JAX`: the same equations as XLA compiles them. "
        "The ratio is CasADi's fastest program to switchfit's call.",
    )
    cases: list[tuple[str, Any, int | None, bool]] = [
        ("no reference, 60 rows", vehicle.without_reference(), COARSE, False),
        ("reference, 60 rows", vehicle.with_reference(COARSE), COARSE, True),
    ]
    if not quick:
        cases += [
            ("no reference, default mesh", vehicle.without_reference(), None, False),
            ("reference, default mesh", vehicle.with_reference(), None, True),
        ]
    forms: list[str] | None = None
    for name, problem, cells, reference in cases:
        found = compare(problem, cells, reference, 30 if quick else 200, forms, quick)
        _show(report, name, found)
        casadi = sorted(found["casadi"], key=lambda form: found["casadi"][form]["median"])
        if forms is None:
            forms = casadi[:CONTENDERS]
        ratio = found["casadi"][casadi[0]]["median"] / found["switchfit call"]["median"]
        report.target(f"(J, g, H), {name}: CasADi / switchfit", TARGET, ratio, "x", at_least=True)
        if "casadi C" in found:
            ratio = found["casadi C"]["median"] / found["switchfit call"]["median"]
            report.target(f"(J, g, H), {name}: CasADi compiled to C / switchfit", 1.0, ratio, "x", at_least=True)
        report.data[name] = found


def compare(
    problem: Any, cells: int | None, reference: bool, repetitions: int, forms: list[str] | None, quick: bool
) -> dict[str, Any]:
    """Times and accuracy of both sides on one mesh."""
    from benchmarks import casadi_forms

    evaluator = vehicle.evaluator_with(problem, cells)
    theta = problem.initial_theta
    rows = vehicle.table_of_rows(evaluator, theta)
    ours = evaluator(theta)
    calls: dict[str, Any] = {
        "switchfit call": lambda: evaluator(theta),
        "switchfit program": machine_code(evaluator, theta),
        "switchfit in JAX": lambda: evaluator(theta, method="discrete-adjoint"),
    }
    build_seconds, gaps = {}, {}
    chosen = forms or (casadi_forms.QUICK if quick else list(casadi_forms.FORMS))
    for form in chosen:
        began = time.perf_counter()
        function = casadi_forms.FORMS[form](rows, reference)
        build_seconds[form] = time.perf_counter() - began
        program = casadi_forms.Timed(function)
        gaps[form] = gap(ours, *program(theta))
        if gaps[form] > AGREEMENT:
            raise ArithmeticError(f"CasADi ({form}) and switchfit differ by {gaps[form]:.1e}")
        calls[form] = partial(program, theta)
        if form == chosen[0]:
            calls["casadi call"] = lambda f=function: [result.full() for result in f(theta)]
    compiled = None if quick else compiled_c(casadi_forms.FORMS[COMPILED](rows, reference))
    if compiled is not None:
        calls["casadi C"] = partial(casadi_forms.Timed(compiled), theta)
    timings = take_turns(calls, repetitions)
    exact = evaluator.divide(4).cost(theta)
    return {
        "rows": len(rows),
        "cost error": abs(ours.cost - exact) / abs(exact),
        **{name: vars(timings[name]) for name in calls if name not in chosen},
        "casadi": {
            form: {**vars(timings[form]), "gap": gaps[form], "build seconds": build_seconds[form]} for form in chosen
        },
    }


def gap(ours: Any, J: float, g: np.ndarray, H: np.ndarray) -> float:
    """Largest difference in J, gradient or Hessian, each relative to its largest entry."""
    pairs = ((ours.cost, J), (ours.gradient, g), (ours.hessian, H))
    return max(float(np.max(np.abs(np.subtract(a, b))) / np.max(np.abs(a))) for a, b in pairs)


def machine_code(evaluator: Evaluator, theta: np.ndarray) -> Any:
    """What `Evaluator.__call__` calls, without what Python does before and after."""
    structure, arguments = evaluator.problem.structures[0], evaluator.arguments[0]
    native = native_experiment(structure, arguments, evaluator.meshes[0].times, Order.HESSIAN)
    if native is None:
        raise RuntimeError("the problem has no machine code")
    tau, p = evaluator.problem.vectors(theta, 0)
    native(tau, p, 1.0)
    return lambda: native._function(native._address, *native._counts)


def compiled_c(function: Any) -> Any:
    """A CasADi function compiled by gcc, or None without gcc."""
    import casadi as ca

    if shutil.which("gcc") is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder) / "function.c", Path(folder) / "function.so"
        generator = ca.CodeGenerator(source.name)
        generator.add(function)
        generator.generate(f"{folder}/")
        command = ["gcc", "-O3", "-march=native", "-fPIC", "-shared", str(source), "-o", str(library), "-lm"]
        subprocess.run(command, check=True)
        return ca.external(function.name(), str(library))


def _show(report: Report, name: str, found: dict[str, Any]) -> None:
    ours = found["switchfit call"]["median"]
    report.note(f"**{name}** ({found['rows']} rows, J in error by {found['cost error']:.1e})")
    rows = []
    for form in ("switchfit call", "switchfit program", "switchfit in JAX", "casadi call", "casadi C"):
        if form in found:
            rows.append((form, found[form], "", ""))
    for form, timing in sorted(found["casadi"].items(), key=lambda item: item[1]["median"]):
        rows.append((f"CasADi: {form}", timing, f"{timing['gap']:.0e}", f"{timing['build seconds']:.1f} s"))
    report.table(
        ("", "median", "minimum", "to switchfit's call", "gap", "built in"),
        [(label, ms(t["median"]), ms(t["minimum"]), f"{t['median'] / ours:.2f}", g, b) for label, t, g, b in rows],
    )
