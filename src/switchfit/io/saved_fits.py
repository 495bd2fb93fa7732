"""Save fits as JSON files that can be read without switchfit, and read them without losing a bit.

A file holds ``{"verdict": {...}, "format": "switchfit fit", "version": 11, "seal": "...", "fit": {...}, "certificate":
{...}}`` with the fields of `Verdict`, `Fit` and `Certificate` under their own names. The verdict, with its line of
text, is meant for readers of the file; `load` computes it again from the rest. ``"provenance"`` holds the fields of
`Provenance`: what the fit was made from. Files without it are read too. `runtime.files` says how numbers, arrays and
dataclasses are written.

The seal is a digest of fit and certificate: a file in which a number was changed, or lost, is refused.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from switchfit.fit.result import Fit
from switchfit.fit.trajectory import Trajectory
from switchfit.io.provenance import Provenance, make_relative
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem
from switchfit.problem.validation.objects import as_instance, as_path
from switchfit.runtime.json_documents import read_document, write_document
from switchfit.runtime.json_records import from_json, to_json
from switchfit.uncertainty.certificate import Certificate
from switchfit.uncertainty.verdict import Verdict, judge

FIT_FORMAT = "switchfit fit"
FIT_VERSION = 11

FIT_FIELDS = (
    "status", "cost", "optimality", "tolerance", "iterations", "earlier_iterations", "active", "kinks", "idle",
    "smallest_eigenvalue", "flat_direction", "violated", "reason", "unread", "absent", "theta_names", "theta_units",
    "initial_theta", "theta", "lower", "upper", "run_names", "transition_times", "transition_places", "final_places",
    "parameters", "parameter_units", "fixed", "gradient", "hessian", "evaluations", "history", "free_basis",
    "trajectories", "comparisons", "sigma_known", "integration_error", "hessian_kind", "seconds", "log_origins",
    "constraints", "saved_gauss_newton", "saved_pieces", "saved_piece_places", "priors", "log_scaled",
    "least_squares", "engine", "integration_error_of", "starts", "rivals", "steps", "initial_cost",
)  # fmt: skip
"""Fields of a fit in the order of the file: those of all its records, side by side."""


def save_fit(fit: Fit, certificate: Certificate, path: Path, provenance: Provenance | None = None) -> None:
    """Write a fit to a file, whole or not at all.

    Parameters
    ----------
    fit : Fit
        Only the fields of `Fit` are written, also for a subclass.
    certificate : Certificate
    path : Path
        An existing file is replaced.
    provenance : Provenance, optional
        What the fit was made from.

    Raises
    ------
    OSError
        If the file cannot be written; an existing one is then left as it was.
    """
    content = write_fit(fit, certificate)
    if provenance is not None:
        # From the folder of the file that is written: both may be moved together. An empty one stays empty.
        folder = provenance.folder and make_relative(provenance.folder, path.resolve().parent)
        content["provenance"] = to_json(replace(provenance, folder=folder), Provenance)
    write_document(content, Path(path))


def write_fit(fit: Fit, certificate: Certificate) -> dict[str, Any]:
    """Return the content of the file of a fit, without its provenance.

    Parameters
    ----------
    fit : Fit
    certificate : Certificate
    """
    # As it will be judged when it is loaded.
    verdict = judge(fit, certificate)
    fields = to_json(fit, Fit)
    sealed = {"fit": {name: fields[name] for name in FIT_FIELDS}, "certificate": to_json(certificate, Certificate)}
    return {
        "verdict": {"level": verdict.level, "text": str(verdict)} | to_json(verdict, Verdict),
        "format": FIT_FORMAT,
        "version": FIT_VERSION,
        "seal": _compute_seal(sealed),
        **sealed,
    }


def _compute_seal(content: Mapping[str, Any]) -> str:
    """Return a digest of the fit and the certificate in the content of a file, whatever its layout."""
    # Parsed and written again with sorted keys: spaces and the order of keys do not count, every digit of a number
    # does.
    sealed = [content.get("fit"), content.get("certificate")]
    return hashlib.sha256(json.dumps(sealed, sort_keys=True).encode()).hexdigest()


def parse_fit(content: Mapping[str, Any]) -> tuple[Fit, Certificate]:
    """Return a fit and its certificate from the content of a file of this version.

    Parameters
    ----------
    content : mapping

    Raises
    ------
    ValueError
        If the content is not what `write_fit` returned.
    """
    if not isinstance(content, Mapping) or content.get("seal") != _compute_seal(content):
        raise ValueError("its content is not what was written")
    return from_json(Fit, content["fit"], "fit"), from_json(Certificate, content["certificate"], "certificate")


def load_fit(path: str | Path, problem: Problem | None = None) -> tuple[Fit, Certificate, Provenance | None]:
    """Return what `save_fit` wrote, with the folder of the problem file as it is from here.

    Parameters
    ----------
    path : str or Path
    problem : Problem, optional
        That may be the one that was fitted.

    Raises
    ------
    OSError
        If there is no such file (FileNotFoundError) or it cannot be read.
    ValueError
        If it is not valid JSON, not written by switchfit, of another version, or not as it was written, or the problem
        has other unknowns or other time units.
    """
    file = as_path(path, "path")
    content = read_document(file, "a saved estimate", FIT_FORMAT, FIT_VERSION)
    try:
        fit, certificate = parse_fit(content)
        provenance = from_json(Provenance | None, content.get("provenance"), "provenance")
    # What a file of arbitrary JSON can raise: nested without end, numbers beyond int64, lengths that no memory holds.
    except (ValueError, OverflowError, RecursionError, MemoryError) as error:
        raise ValueError(f"{path} is damaged: {error}.") from error
    if provenance is not None and provenance.folder:
        folder = os.path.normpath(file.resolve().parent / provenance.folder)
        provenance = replace(provenance, folder=folder)
    if problem is not None:
        _check_problem(fit, problem, path)
    return fit, certificate, provenance


def _check_problem(fit: Fit, problem: Problem, path: str | Path) -> None:
    """Raise ValueError unless a fit that was loaded from a file may be that of a problem."""
    as_instance(problem, "problem", Problem, "an sf.Problem")
    if problem.theta_names != fit.theta_names:
        raise ValueError(
            f"{path} holds the unknowns {', '.join(fit.theta_names)}, the problem has "
            f"{', '.join(problem.theta_names)}: it is the fit of another problem."
        )
    runs = fit.trajectories, problem.experiments
    # By the instant, not by the text of the date: zones may be named in several ways.
    clocks = [[(run.time_unit, run.origin and run.origin.instant) for run in each] for each in runs]
    if clocks[0] != clocks[1]:
        saved, given = (", ".join(map(_describe_clock, each)) for each in runs)
        raise ValueError(
            f"{path} holds times in {saved}, the problem has them in {given}, and times are not converted: give the "
            "problem's experiments the time_unit and the origin of the file."
        )


def _describe_clock(run: Trajectory | Experiment) -> str:
    return run.time_unit if run.origin is None else f"{run.time_unit} since {run.origin.date}"
