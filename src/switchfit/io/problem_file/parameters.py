"""Build the parameters of a problem file, with bounds, scales and priors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from switchfit.io.problem_file import tables
from switchfit.io.problem_file.tables import Contents
from switchfit.io.user_files import build_at
from switchfit.problem.experiment import Parameter
from switchfit.problem.priors import LogNormal, Normal


def build_parameter(table: tables.ParameterTable) -> Parameter:
    """Return the unknown that a table describes.

    Parameters
    ----------
    table : ParameterTable
    """
    # Without what is left out, so that the defaults are those of `Parameter`.
    given = table.model_dump(exclude_none=True)
    if (prior := given.pop("prior", None)) is not None:
        kinds: dict[tuple[str, ...], Any] = {("mean", "sd"): Normal, ("median", "log_sd"): LogNormal}
        if (kind := kinds.get(tuple(prior))) is None:
            raise ValueError(f"prior needs mean and sd (normal), or median and log_sd (log-normal); got {prior}.")
        given["prior"] = kind(**prior)
    return Parameter(**given)


def build_parameters(path: Path, contents: Contents) -> dict[str, Parameter]:
    """Return the parameters of a problem file.

    Parameters
    ----------
    path : Path
    contents : Contents
    """
    given = contents.parameters.items()
    return {name: build_at(f"{path}: parameters.{name}", build_parameter, table) for name, table in given}
