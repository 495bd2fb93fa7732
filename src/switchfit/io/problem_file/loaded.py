"""What a problem file says, with the problem that was built from it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from switchfit.io.problem_file.tables import Contents

if TYPE_CHECKING:
    from switchfit.estimation.provenance import Provenance
    from switchfit.problem.problem import Problem
    from switchfit.runtime.issue import Issue


@dataclass(frozen=True)
class ProblemFile:
    """Contents of a problem file.

    Attributes
    ----------
    path : Path
    problem : Problem
    options : dict
        Keyword arguments for `switchfit.estimate` that the file sets.
    provenance : Provenance
        The text of the file, and hashes of the files that it names: for `Estimate.save`.
    issues : tuple of Issue
        What is odd about the logs; of kind "log: refused" for those of many that could not be used.
    library : dict
        Keyword arguments for `switchfit.find_modes` that the file sets.
    contents : Contents
        The tables of the file, with an experiment for each log that could be used.
    """

    path: Path
    problem: Problem
    options: dict[str, Any]
    provenance: Provenance
    issues: tuple[Issue, ...] = ()
    library: dict[str, Any] = field(default_factory=dict)
    contents: Contents = field(default_factory=Contents, repr=False)
