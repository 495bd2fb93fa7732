"""A mode sequence that was found as a problem file, which `switchfit fit` fits to the same answer."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from switchfit.cli.toml_writer import write_table
from switchfit.estimation.estimates import Estimate
from switchfit.io.problem_file.building import ProblemFile
from switchfit.io.provenance import make_relative
from switchfit.io.user_files import replace_files
from switchfit.problem.experiment import Experiment
from switchfit.runtime.errors import InputError


def write_fitted_problem(loaded: ProblemFile, estimate: Estimate, folder: Path) -> str:
    """Return the text of a problem file with the mode sequences and the values of an estimate.

    Initial states that the model has, and not the file, stay with the model.

    Parameters
    ----------
    loaded : ProblemFile
        That was searched.
    estimate : Estimate
        Of the sequences that were found.
    folder : Path
        Where the text will be, from which paths in it lead to data and models.

    Raises
    ------
    InputError
        If the problem is built in Python.
    """
    contents, problem = loaded.contents, estimate.evaluator_at_solution().problem
    if contents.problem is not None:
        raise InputError(
            f"{loaded.path} names a problem that {contents.problem.name!r} builds in Python: write the sequence there."
        )
    # What the user wrote, and nothing that is a default: the file stays as short as it was.
    tables = contents.model_dump(exclude_unset=True, exclude_none=True)
    for e, (table, run) in enumerate(zip(tables["experiments"], problem.experiments, strict=True)):
        table |= _describe_run(estimate, e, run)
        # A state that the file says is known stays known; the others get their estimates as guesses.
        for entry, value in zip(table.get("initial_state", ()), estimate.initial_state[e], strict=False):
            if not entry.get("fixed"):
                entry["value"] = _confine(value, entry.get("lower", -np.inf), entry.get("upper", np.inf))
    parameters = tables.get("parameters", {})
    for name, table in parameters.items():
        parameter = problem.parameters[name]
        table["value"] = _confine(estimate.parameters[name], parameter.lower, parameter.upper)
        if parameter.fixed:  # the search has held it
            table["fixed"] = True
        # A bare number where nothing else is known, as it is written by hand.
        parameters[name] = table["value"] if set(table) == {"value"} else table
    # The search may have used other durations than the file; those that it used make the same problem.
    options = {key: value for key, value in tables.get("options", {}).items() if key != "min_duration"}
    durations = problem.min_duration  # the library may have had a shorter one
    if isinstance(durations, Mapping):
        durations = {mode: seconds for mode, seconds in durations.items() if seconds}
    tables["options"] = options | ({"min_duration": durations} if durations else {})
    home = loaded.path.absolute().parent
    # Paths are relative to the file that has them, which is another folder now.
    moved = replace_files(tables, lambda name: name if Path(name).is_absolute() else make_relative(home / name, folder))
    head = f"# Written by switchfit modes: the best mode sequence of {loaded.path.name}, with its estimates as guesses."
    return "\n".join([head, *write_table(moved), ""])


def _describe_run(estimate: Estimate, e: int, run: Experiment) -> dict[str, Any]:
    """Return the keys of an experiment that a search has found, and its origin: times are then numbers."""
    found = {"mode_sequence": list(run.mode_sequence), "transition_times": estimate.transition_times[e].tolist()}
    # Times of the fit are numbers since the origin, which the file may have left to the data.
    if run.origin is not None:
        found["origin"] = run.origin.date
        if run.time_zone is not None:
            found["time_zone"] = run.time_zone
    return found


def _confine(value: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> float | list[float]:
    """Return an estimate as numbers of Python; rounding must not take it over a bound."""
    confined: float | list[float] = np.clip(np.asarray(value, dtype=float), lower, upper).tolist()
    return confined
