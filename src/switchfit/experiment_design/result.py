"""The result of `design`: an experiment, and how well it will determine the unknowns."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.fit.simulation import simulate
from switchfit.fit.trajectory import Trajectory
from switchfit.problem.problem import Problem
from switchfit.problem.validation import objects
from switchfit.runtime.json_documents import write_document
from switchfit.runtime.json_records import to_json
from switchfit.runtime.presentation import Figure, Printed, draw_figure, format_line, join_first


@dataclass(frozen=True, eq=False)
class DesignRecord:
    """What of a design is saved; see `Design`."""

    run: str
    theta_names: tuple[str, ...]
    theta: FloatArray
    names: tuple[str, ...]
    criterion: str
    criterion_before: float
    criterion_after: float
    covariance_before: FloatArray
    covariance: FloatArray
    inputs: dict[str, FloatArray]
    sample_times: dict[str, FloatArray]
    shares: dict[str, FloatArray]
    seconds: float


@dataclass(frozen=True, eq=False)
class Design(DesignRecord, Printed):
    """Result of `design`: an experiment, and how well it will determine the unknowns. Print it for the tables.

    Attributes
    ----------
    run : str
        The run that was designed.
    theta_names : tuple of str, d unknowns of the problem
    theta : (d,)
        At which the information is computed.
    names : tuple of str
        The unknowns that count.
    criterion : {"D", "A", "E"}
    criterion_before, criterion_after : float
        Of the problem as it was given, with all of its samples, and of the design: log det (D), trace (A) or largest
        eigenvalue (E) of the covariance of the unknowns that count, divided by their scales. Infinite where one of them
        cannot be estimated.
    covariance_before, covariance : (d, d)
        Of all unknowns; NaN for those that cannot be estimated.
    inputs : dict of str to (K,) array
        Values of each entry of the input at its knots; empty without an input.
    sample_times : dict of sensor to (K,) array
        Times of the samples, of the sensors that are used.
    shares : dict of sensor to (K,) array
        Share of the information of each sample of `given`. Those of the samples that are taken, of priors and of other
        runs add up to 1; the share of one that is left out says what it would bring.
    seconds : float
    problem : Problem
        With the designed run, ready to simulate and, once its simulated values are replaced by measured ones, to fit.
    given : Problem
        As it was given.
    experiment : int
        Index of the run.

    See Also
    --------
    design

    Examples
    --------
    >>> plan = sf.design(heater_problem(), samples=4)
    >>> plan.sample_times["thermometer"].shape, plan.undetermined
    ((4,), ())
    """

    problem: Problem
    given: Problem
    experiment: int

    def __repr__(self) -> str:
        change = f"{self.criterion_before:.4g} -> {self.criterion_after:.4g}"
        return format_line(self, self.run, f"{self.criterion} of {join_first(self.names)}: {change}")

    @property
    def standard_errors(self) -> FloatArray:
        """Of all unknowns, with the design: (d,); NaN for those that cannot be estimated."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def standard_errors_before(self) -> FloatArray:
        """Of all unknowns, with the problem as it was given: (d,)."""
        return np.sqrt(np.diag(self.covariance_before))

    @property
    def undetermined(self) -> tuple[str, ...]:
        """The unknowns that the design cannot determine, whatever will be measured."""
        return tuple(np.array(self.theta_names)[np.isnan(self.standard_errors)].tolist())

    @property
    def doubtful(self) -> tuple[str, ...]:
        """The unknowns whose standard error is larger than their distance to a bound or to the next transition: the
        errors of a fit will not be those of a linear model.
        """
        u, errors = self.problem.unknowns, np.nan_to_num(self.standard_errors)
        beyond = (self.theta - errors < u.lower) | (self.theta + errors > u.upper)
        # Rows of A are differences of neighbouring times: the error of either of them against the room between them.
        beyond |= np.any(np.abs(u.A) * errors > (u.A @ self.theta - u.b)[:, None], axis=0)
        return tuple(np.array(self.theta_names)[beyond].tolist())

    @cached_property
    def trajectory(self) -> Trajectory:
        """The designed run at `theta`."""
        return simulate(self.problem, self.theta, experiment=self.experiment)

    def plot(self) -> Figure:
        """Draw the input as it was given and as designed, the states, and the share of the information of each sample.

        See Also
        --------
        design

        Examples
        --------
        >>> figure = sf.design(heater_problem(), samples=4).plot()
        >>> [ax.get_ylabel() for ax in figure.axes]
        ['T (K)', 'share of information']
        """
        figure: Figure = draw_figure(self)
        return figure

    def save(self, path: str | Path) -> None:
        """Write everything but the problems to a JSON file, atomically.

        Parameters
        ----------
        path : path

        See Also
        --------
        design

        Examples
        --------
        >>> import json
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> plan = sf.design(heater_problem(), samples=4)
        >>> with TemporaryDirectory() as folder:
        ...     plan.save(Path(folder) / "design.json")
        ...     json.loads((Path(folder) / "design.json").read_text())["design"]["names"]
        ['tau_1', 'k']
        """
        content = {"format": "switchfit design", "version": 1, "design": to_json(self, DesignRecord)}
        write_document(content, objects.as_path(path, "path"))
