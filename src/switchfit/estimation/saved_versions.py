"""Files of fits that earlier versions of switchfit have written, upgraded to the version of today."""

from __future__ import annotations

from typing import Any

import numpy as np

from switchfit.problem.constraints import Constraint
from switchfit.runtime.errors import get_first_line
from switchfit.runtime.json_records import shorten_json, to_json

DATA = 4
"""The first version that holds data in place of sentences."""


def upgrade(content: dict[str, Any], version: int) -> None:
    """Upgrade the content of a file of an earlier version to version 7, in place."""
    try:
        if version < DATA:
            _upgrade_fit(content["fit"])
            _upgrade_certificate(content["certificate"], content["fit"])
        if content["fit"]["engine"] is not None:
            content["fit"]["engine"].setdefault("implicit_modes", [])
        content["fit"].setdefault("starts", None)
        content["fit"].setdefault("saved_profiles", [])
        content["fit"].setdefault("unread", [])
        content["fit"].setdefault("absent", [])
        content["fit"].setdefault("steps", [])
        content["fit"].setdefault("initial_cost", _read_first_cost(content["fit"]["history"]))
        for comparison in (comparison for run in content["fit"]["comparisons"] for comparison in run):
            comparison.setdefault("weights", None)
            comparison.setdefault("units", [])
        for trajectory in content["fit"]["trajectories"]:
            trajectory.setdefault("origin", None)
    except (LookupError, TypeError, AttributeError) as error:
        raise ValueError(
            f"it does not match the format of version {content['version']} ({get_first_line(error)})"
        ) from error


def _read_first_cost(history: list[dict[str, Any]]) -> Any:
    """Return J at the first guess: before there were strategies, every history began there."""
    return history[0]["cost"] if history else "NaN"


def _upgrade_fit(fit: dict[str, Any]) -> None:
    names, theta = fit["theta_names"], fit["theta"]
    for trajectory in fit["trajectories"]:
        trajectory.setdefault("time_unit", "s")
    fit.update({"engine": None, "idle": [], "integration_error_of": "J"} | fit)  # files of version 2 lack them
    fit["run_names"], fit["transition_places"] = _find_transitions(fit)
    units = {name.partition("[")[0]: unit for name, unit in zip(names, fit["theta_units"], strict=False)}
    fit["parameter_units"] = {name: units.get(name, "") for name in fit["parameters"]}
    fit["fixed"] = [name for name in fit["parameters"] if name not in units]
    fit["kinks"] = [
        {"unknown": name, "value": theta[names.index(name)] if name in names else "NaN", "left": left, "right": right}
        for name, left, right in fit["kinks"]
    ]
    known = _list_possible_constraints(fit)
    for k, text in enumerate(fit["active"]):
        if text not in known:
            raise ValueError(f"fit.active[{k}] is not a constraint of this fit; got {shorten_json(text)}")
    fit["active"] = [known[text] for text in fit["active"]]
    fit["reason"] = {"kind": "message", "subjects": [fit.pop("message")], "figures": {}}
    fit |= {"earlier_iterations": 0, "smallest_eigenvalue": "NaN", "flat_direction": [], "violated": []}


def _upgrade_certificate(certificate: dict[str, Any], fit: dict[str, Any]) -> None:
    certificate.setdefault("integration_error_of", "J")
    del certificate["worst_direction"]
    failures = [{"kind": "message", "subjects": [text], "figures": {}} for text in certificate["failures"]]
    certificate |= {"worst_unknowns": [], "active": fit["active"], "kinks": fit["kinks"], "failures": failures}


def _find_transitions(fit: dict[str, Any]) -> tuple[list[str], list[Any]]:
    """Return the names of the runs and the indices of transition times in theta, from the names of the unknowns.

    Free transition times come first in theta, in order, with names ``tau_i`` or ``run.tau_i``.
    """
    names, theta, all_times = fit["theta_names"], fit["theta"], fit["transition_times"]
    runs, all_places, place = [], [], 0
    for e, given in enumerate(all_times):
        run = f"run{e + 1}"
        times = given["values"] if isinstance(given, dict) else given
        places = []
        for i, time in enumerate(times):
            name = f".{names[place]}" if place < len(names) else ""
            free = name.endswith(f".tau_{i + 1}") and theta[place] == time
            run = name.removesuffix(f".tau_{i + 1}")[1:] or run if free else run
            places.append(place if free else -1)
            place += free
        runs.append(run)
        all_places.append({"dtype": "<i8", "shape": [len(places)], "values": places})
    return runs, all_places


def _list_possible_constraints(fit: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return every linear constraint that may be active, by its sentence in version 3."""
    found = {}
    for name, low, high in zip(fit["theta_names"], fit["lower"], fit["upper"], strict=False):
        for side, value in (("lower", low), ("upper", high)):
            bound = Constraint(f"{side} bound", float(value), unknown=name)  # type: ignore[arg-type]  # one of the kinds
            found[f"{name} at its {side} bound {float(value):g}"] = bound
    single = len(fit["trajectories"]) == 1
    for run, trajectory in zip(fit["run_names"], fit["trajectories"], strict=False):
        modes, starts = trajectory["modes"]["values"], trajectory["segments"]["values"][:-1]
        for i, mode in enumerate(modes[start] for start in starts):
            where = f"mode {i + 1} ({mode!r})" + ("" if single else f" of {run}")
            place = {"mode": mode, "position": i, "run": "" if single else run}
            found[f"{where} has collapsed to nothing"] = Constraint("collapsed", 0.0, **place)
            found[f"{where} is at its minimum duration"] = Constraint("minimum duration", np.nan, **place)
    return {text: to_json(constraint, Constraint) | {"multiplier": "NaN"} for text, constraint in found.items()}
