"""One answer from one library in a process of its own: ``python -m benchmarks.answer derivatives heyoka``.

`cold.py` times these processes. ``derivatives`` is (J, gradient, Hessian) of the vehicle at the guess, at settings that
give J to some 1e-8; ``fit`` is the fishing problem from the published switches. J is printed, so that the parent can
see that all answers agree. A library is imported only where it is asked for.
"""

from __future__ import annotations

import importlib
import sys
from typing import Any

import numpy as np

from benchmarks import models

SETTINGS = {"casadi": 96, "diffrax": 1e-8, "heyoka": 1e-7, "scipy": 1e-8}
"""Steps or tolerances for the vehicle: those that the part `peers` found to be accurate enough. CasADi loops
over its steps: one graph of them all takes seconds to build."""

MODULES = {
    "casadi": "casadi_shooting",
    "diffrax": "diffrax_hessian",
    "heyoka": "heyoka_variational",
    "scipy": "scipy_differences",
}
ELEMENTS = 8
DERIVATIVES = ("switchfit", *MODULES)
FITS = ("switchfit", "casadi", "scipy")


def derivatives(library: str) -> float:
    """J of the vehicle, the gradient and Hessian having been computed as well."""
    if library == "switchfit":
        import switchfit as sf
        from benchmarks import problems

        return sf.evaluate(problems.case("vehicle").problem(rtol=1e-9, atol=1e-11)).cost
    build = importlib.import_module(f"benchmarks.peers.{MODULES[library]}").build
    model = models.VEHICLE
    more = {"diffrax": _for_diffrax, "casadi": lambda model: {"unrolled": False}}.get(library, lambda model: {})
    functions = build(model, SETTINGS[library], **more(model))
    return functions.hessian(model.theta)[0]


def _for_diffrax(model: models.Model) -> dict[str, Any]:
    """The vector fields in `jax.numpy`, without switchfit."""
    import jax.numpy as jnp

    from benchmarks.peers.diffrax_hessian import WAYS

    modes = {m: lambda t, x, p, m=m: jnp.stack(model.field(m, x, p, jnp)) for m in model.modes}
    return {"modes": modes, "pack": lambda p: p, "way": WAYS[0]}


def fit(library: str) -> float:
    """J where the fit of the fishing problem ends."""
    model, start = models.FISHING, np.array(models.FISHING_START)
    if library == "switchfit":
        import switchfit as sf
        from benchmarks import problems

        return sf.estimate(problems.case("fishing").problem(start)).cost
    if library == "casadi":
        from benchmarks.peers.casadi_collocation import Collocation

        none = np.zeros(0)
        return Collocation(model, ELEMENTS, (none, none))(start).cost
    import scipy.optimize

    from benchmarks.peers.scipy_differences import cost_of

    order = {"type": "ineq", "fun": np.diff, "jac": lambda theta: np.diff(np.eye(len(theta)), axis=0)}
    options = {"ftol": 1e-12, "finite_diff_rel_step": 1e-6}
    box = [model.horizon] * len(start)
    cost = cost_of(model, 1e-10)
    found = scipy.optimize.minimize(cost, start, method="SLSQP", bounds=box, constraints=order, options=options)
    return float(found.fun)


if __name__ == "__main__":
    print(repr({"derivatives": derivatives, "fit": fit}[sys.argv[1]](sys.argv[2])))
