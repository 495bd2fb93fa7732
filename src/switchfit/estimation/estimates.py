"""Estimate: the result of a fit, with methods for uncertainty, prediction, figures and files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.arrays import FloatArray
from switchfit.estimation.provenance import Provenance
from switchfit.estimation.saving import FIT_FORMAT, FIT_VERSION, parse_fit, save_fit
from switchfit.fit.comparison import compare
from switchfit.fit.result import Fit, invert
from switchfit.fit.statistics import measure_quantile
from switchfit.fit.trajectory import Trajectory
from switchfit.meshes.evaluator import Evaluator
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem
from switchfit.problem.validation.names import as_choice
from switchfit.problem.validation.objects import as_flag, as_instance, as_path
from switchfit.runtime.files import write_atomically
from switchfit.runtime.frames import Tabular, build_pandas, describe_frame
from switchfit.runtime.json_documents import read_document
from switchfit.runtime.json_records import from_json
from switchfit.runtime.presentation import (
    Displayed,
    Drawn,
    Figure,
    draw_figure,
    format_line,
    format_page,
    format_text,
    join_first,
    validate_on,
)
from switchfit.runtime.progress import Progress
from switchfit.uncertainty.certificate import Certificate, certify
from switchfit.uncertainty.corrected_errors import correct_errors, measure_widening
from switchfit.uncertainty.density_intervals import replace_where_cost_jumps
from switchfit.uncertainty.identification import Identifiability, identifiability
from switchfit.uncertainty.prediction import Prediction, predict
from switchfit.uncertainty.profile_pieces import replace_intervals
from switchfit.uncertainty.profiles import Profile, profile
from switchfit.uncertainty.residuals import ResidualDiagnostics, diagnose
from switchfit.uncertainty.sample_derivatives import build_gauss_newton, collect_sample_derivatives
from switchfit.uncertainty.sensitivity import Sensitivity, compute_sensitivities
from switchfit.uncertainty.transition_profiles import HIGHEST_LEVEL, compute_threshold, trace_profiles
from switchfit.uncertainty.verdict import Verdict, judge

if TYPE_CHECKING:
    import pandas

TableKind = Literal["unknowns", "trajectories", "residuals", "history"]
ESTIMATE_TABLES = get_args(TableKind)
CovarianceKind = Literal["exact", "gauss-newton", "sandwich"]

MOST_SENSITIVITIES = 2**28
"""Largest size, in bytes, of the derivatives of states and outputs at all nodes; above it, figures have no bands."""


@dataclass(frozen=True, eq=False)
class Estimate(Fit, Tabular, Displayed):
    """Result of `estimate`: everything in `Fit`, with methods that need the model. Print it for the report.

    Attributes
    ----------
    provenance : Provenance or None
        What a loaded estimate was made from, if its file says so: problem file, hashes of files, versions.

    See Also
    --------
    estimate : returns it.
    Fits : many fits at once.

    Examples
    --------
    >>> fit = sf.estimate(heater_problem())

    >>> fit.success, fit.status.name
    (True, 'CONVERGED')
    >>> dict(zip(fit.theta_names, fit.theta.round(3).tolist()))
    {'tau_1': 2.462, 'k': 0.393}
    >>> fit.standard_errors.round(3)
    array([0.018, 0.005])
    >>> fit.trajectory.mode_spans[0][0]
    'on'
    """

    saved_certificate: Certificate | None = None
    problem: Problem | None = None
    evaluator: Evaluator | None = None
    provenance: Provenance | None = None

    def __repr__(self) -> str:
        unknowns = (f"{name} = {value:.4g}" for name, value in zip(self.theta_names, self.theta, strict=True))
        return format_line(self, self.verdict.level, f"J = {self.cost:.6g}", join_first(unknowns))

    def simulate_later(self, evaluator: Evaluator) -> None:
        """Compute `trajectories` and `comparisons` on some meshes at the first access; many fits never need them.

        See Also
        --------
        Estimate.complete

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> len(fit.trajectories)
        1
        >>> fit.simulate_later(fit.evaluator_at_solution())
        >>> fit.trajectory.states.shape[1]
        1
        """
        for name in ("trajectories", "comparisons"):
            del self.__dict__[name]
        self.__dict__["_shown_on"] = evaluator

    def __getattr__(self, name: str) -> Any:
        """Compute `trajectories` or `comparisons` at the first access."""
        if "_shown_on" not in self.__dict__ or name not in ("trajectories", "comparisons"):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)
        trajectories, comparisons = compare(self.__dict__.pop("_shown_on"), self.theta)
        self.__dict__.update(trajectories=trajectories, comparisons=comparisons)
        return self.__dict__[name]

    @cached_property
    def certificate(self) -> Certificate:
        """Checks of the numbers. The paper's equations are evaluated for it, at the first access.

        An estimate that was loaded without its model has the certificate that was saved.
        """
        if self.saved_certificate is not None:
            return self.saved_certificate
        self.__dict__.pop("verdict", None)  # from now on it includes the check of derivatives
        return certify(self, None if self.problem is None else Evaluator(self.problem, self.theta))

    @cached_property
    def verdict(self) -> Verdict:
        """Whether to believe the numbers: good, doubtful or bad, why, and what to do next. Print it for one line.

        It includes the check of derivatives if the certificate was accessed before, or loaded.
        """
        return judge(self, self.known_certificate)

    @property
    def success(self) -> bool:
        """Whether the fit converged and its verdict is not bad; ``status.successful`` says whether it converged."""
        return self.status.successful and self.verdict.level != "bad"

    @property
    def corrected_standard_errors(self) -> FloatArray:
        """Standard errors that allow for correlated residuals: (d,); `standard_errors` without such residuals.

        They are the standard errors times sqrt((1 + r) / (1 - r)), where r is the correlation of neighboring residuals,
        and if sigma is known times the root mean square of the residuals in sigmas. The largest factor of all channels
        counts; for a transition time, that of the channels of its own run.
        """
        return correct_errors(self)

    @cached_property
    def corrected_covariance(self) -> FloatArray:
        """Covariance that allows for correlated residuals: (d, d); `covariance` without such residuals.

        Its standard errors are `corrected_standard_errors`, its correlations those of `covariance`. Bands of fitted
        curves follow from it.
        """
        factors = measure_widening(self)
        return np.asarray(factors[:, None] * self.covariance * factors)

    def report(self, *, full: bool = False) -> str:
        """Return the report that `print` shows: the verdict and one screen of numbers.

        Parameters
        ----------
        full : bool
            All experiments, channels, unknowns, correlations, weak directions and warnings, however many.

        See Also
        --------
        Estimate.verdict, Estimate.plot

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> fit.report().splitlines()[0]
        'Good: converged; one fit; the model explains 99.85 % of the variance (chi² 12.1 for 22 degrees of'
        >>> fit.report().splitlines()[-1]
        'More: estimate.report(full=True), switchfit fit --full.'
        """
        return format_text(self, full=True) if as_flag(full, "full") else format_text(self)

    @property
    def known_certificate(self) -> Certificate | None:
        """The certificate, if it was loaded or computed before; else None."""
        return self.saved_certificate or self.__dict__.get("certificate")

    @cached_property
    def gauss_newton(self) -> FloatArray | None:
        """The Gauss-Newton matrix ``sum (D h / sigma)' (D h / sigma)``: (d, d); None if it is unknown."""
        if self.saved_gauss_newton is not None or self.sigma_known is None or self.problem is None:
            return self.saved_gauss_newton
        if not self.problem.estimates_delays and self.has_room_for_sensitivities():
            # From the program of the exact Hessian, which the fit has compiled: 1 ms, and 0.7 s with one of its own.
            samples = collect_sample_derivatives(self.problem, self.sensitivities)
            return build_gauss_newton(self.problem, self.theta, samples)
        return self.evaluator_at_solution()(self.theta, matrix="gauss-newton").hessian

    def covariance_from(self, hessian: CovarianceKind) -> FloatArray:
        """Return the covariance of theta from the exact Hessian, the Gauss-Newton matrix or both sides of it: (d, d).

        Parameters
        ----------
        hessian : {"exact", "gauss-newton", "sandwich"}
            "exact", the observed information, is used by `covariance` and everything else here. The Gauss-Newton
            matrix, the expected information, omits ``sum r D^2 h / sigma^2``: it is positive semi-definite for any
            residuals, and treats the model as linear. "sandwich" is ``n / (n - d) H^-1 B H^-1`` with the exact Hessian
            H and ``B = sum_k g_k g_k'``, g_k being the gradient of the cost of sample k: with a robust loss it holds
            for independent noise of any distribution, whether sigma is right or not. With any of them, unknowns at
            kinks have variances as in `covariance`; those of the sandwich are rough, as each score is of one side.

        Raises
        ------
        ValueError
            For another kind. For "gauss-newton" if the matrix is unknown: it needs a cost of Measurements alone, and
            the problem, unless it was saved. For "sandwich" without the problem, with a cost of other terms,
            with priors, constraints, or a sigma or delay that is a parameter, and with no more values than free
            unknowns.

        References
        ----------
        P. J. Huber, Robust Statistics, Wiley 1981, section 6.3 (covariance of M-estimates); H. White, Maximum
        likelihood estimation of misspecified models, Econometrica 50 (1982) 1-25, theorem 3.2; J. G. MacKinnon,
        H. White, J. Econometrics 29 (1985) 305-325 (the factor n / (n - d)).

        See Also
        --------
        Estimate.covariance

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> fit.covariance_from("gauss-newton").shape
        (2, 2)
        """
        if as_choice(hessian, "hessian", get_args(CovarianceKind)) == "exact":
            return self.covariance
        if hessian == "gauss-newton":
            if self.gauss_newton is None:
                raise ValueError(
                    "The Gauss-Newton matrix of this fit is not known: it needs a cost of Measurements alone, and the "
                    "problem. Use hessian='exact'."
                )
            return self.variance_scale * invert(self, self.gauss_newton, self.variance_scale)
        if self.problem is None or not self.has_sandwich:
            raise ValueError(
                "The sandwich covariance needs the gradient of each sample: the problem, with a cost of Measurements "
                "alone, without guards, terminal constraints, priors, and parameters that are a sigma or a delay, and "
                "with more values than free unknowns. Use hessian='exact', or sf.profile."
            )
        # MacKinnon and White (1985), HC1, of White (1982), theorem 3.2: C = n / (n - d) H^-1 B H^-1, B = scores' scores
        scores = collect_sample_derivatives(self.problem, self.sensitivities).scores
        spread = scores @ invert(self, self.hessian, self.variance_scale)
        return np.asarray(self.samples / self.freedom * (spread.T @ spread))

    @property
    def has_sandwich(self) -> bool:
        """Whether there is a ``covariance_from("sandwich")``."""
        has_gradients = self.problem is not None and self.sigma_known is not None and self.problem.has_plain_samples
        return has_gradients and not self.constraints and self.freedom > 0

    def has_room_for_sensitivities(self) -> bool:
        """Return whether the derivatives of states and outputs at all nodes take less memory than `MOST_SENSITIVITIES`.

        See Also
        --------
        Estimate.plot, Estimate.predict

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> fit.has_room_for_sensitivities()
        True
        """
        rows = sum(len(mesh.nodes) for mesh in self.evaluator_at_solution().meshes)
        width = 2 * max(trajectory.states.shape[1] for trajectory in self.trajectories)  # about as many outputs
        return 16 * rows * width * len(self.theta) <= MOST_SENSITIVITIES

    @cached_property
    def sensitivities(self) -> tuple[Sensitivity, ...]:
        """States and outputs with their derivatives in theta, one per experiment, on the meshes of the fit."""
        return compute_sensitivities(self.evaluator_at_solution(), self.theta)

    def evaluator_at_solution(self) -> Evaluator:
        """Return the problem on the meshes of the fit; of a loaded estimate on meshes refined at the solution.

        Raises
        ------
        ValueError
            If the estimate was loaded from a file without its problem.

        See Also
        --------
        evaluate

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> evaluator = fit.evaluator_at_solution()
        >>> abs(evaluator(fit.theta).cost - fit.cost) < 1e-12
        True
        """
        if self.problem is None:
            raise ValueError(
                "This estimate was loaded without its model: load it with Estimate.load(path, problem=problem)."
            )
        evaluator = self.evaluator or Evaluator(self.problem, self.theta)  # the meshes of an estimate are not saved
        object.__setattr__(self, "evaluator", evaluator)
        return evaluator

    def confidence_intervals(self, level: float = 0.95, *, hessian: CovarianceKind = "exact") -> FloatArray:
        """Return intervals of all unknowns, cut off at the bounds: (d, 2).

        The interval is ``theta +- quantile x standard error``. For unknowns on a logarithmic scale, theta is multiplied
        and divided by exp(quantile x relative standard error). For a transition time at a kink, or with a sample time
        within five standard errors, it is the range in which 2 (J − J_min) of its profile, followed piece by piece,
        stays below the squared quantile: slope and curvature of the cost jump at every sample time, so that this
        interval is not symmetric. Where what is measured jumps at a transition, J itself jumps at samples, and the
        interval is the middle part of the density exp(-J) of the profile: chi-square does not hold (Hansen 2000).
        An estimate that was loaded without its model has these profiles up to level 0.99;
        one with more than 15 experiments, guards, terminal constraints, or a model with thin layers has ``theta +-
        quantile x standard error`` only. NaN for an unknown that is held by a bound or a collapsed mode.

        Parameters
        ----------
        level : float, between 0 and 1
            The quantile is that of Student's t if sigma is unknown, of the normal distribution if it is known.
        hessian : {"exact", "gauss-newton", "sandwich"}
            As in `covariance_from`. With the last two, no profile is followed at kinks and among samples, and with
            "sandwich" the quantile is that of Student's t in any case.

        See Also
        --------
        profile, bootstrap

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> fit.confidence_intervals(0.95).round(2)
        array([[2.43, 2.5 ],
               [0.38, 0.4 ]])
        """
        intervals = super().confidence_intervals(level)
        if hessian != "exact":
            quantile = measure_quantile(level, max(self.freedom, 1), self.sigma_known and hessian != "sandwich")
            return self.build_intervals(quantile * np.sqrt(np.diag(self.covariance_from(hessian))))
        pieces, places = self._trace_profiles(level)
        found = replace_intervals(intervals, pieces, places, np.array(compute_threshold(self, level)))
        return replace_where_cost_jumps(found, pieces, places, self, level)

    def _trace_profiles(self, level: float = HIGHEST_LEVEL) -> tuple[FloatArray, NDArray[np.intp]]:
        """Return the profiles of transition times with samples near; without the model those that were saved."""
        if self.problem is None:
            return self.saved_pieces, self.saved_piece_places
        return trace_profiles(self, self.problem, self.evaluator_at_solution(), level)

    def profile(self, name: str, *, level: float = 0.95, callback: Progress | None = None) -> Profile:
        """Return the profile likelihood of one parameter or transition time, see `switchfit.profile`.

        Parameters
        ----------
        name : str
        level : float
        callback : callable, optional

        See Also
        --------
        profile, Profile

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> [round(float(end), 1) for end in fit.profile("tau_1").interval()]
        [2.4, 2.5]
        """
        return profile(self, name, level=level, callback=callback)

    def predict(self, times: ArrayLike | None = None, *, experiment: int = 0) -> Prediction:
        """Return states and outputs at any times with their standard errors and bands, see `switchfit.predict`.

        Parameters
        ----------
        times : (K,) array_like, optional
        experiment : int

        See Also
        --------
        predict, Prediction

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> fit.predict([1.0, 4.0]).outputs.round(1)
        array([[8.3],
               [8.6]])
        """
        return predict(self, times, experiment=experiment)

    def validate(self, other: Any, *, refit: Sequence[str] | None = None) -> Any:
        """Return how well the fitted parameters predict another run, as a `Validation`.

        Parameters
        ----------
        other : Experiment, list of Experiment, Problem, Measurements or Log
            The other run. An `Experiment` has the system and the parameters of this fit. Of a `Problem`, parameters
            that this fit has too get its values. `Measurements` are another log of the only experiment of this fit;
            what is left out in them (observe, sigma, delay, names) is as it was there, and so are the channels of a
            `Log`.
        refit : sequence of str, optional
            Unknowns to estimate from the other run, by their names in its problem. If left out, all that are its own:
            its transition times, the unknown entries of its initial state, and parameters that this fit does not have.
            With ``()`` none, and they are what `other` gives: the guess of each transition time. The parameters of
            this fit are never estimated again.

        Returns
        -------
        Validation

        Raises
        ------
        TypeError
            If `other` is of another type.
        ValueError
            If this fit has an input or several runs, and `other` does not have its own; for an unknown name in
            `refit`; for an estimate without its problem.

        See Also
        --------
        Validation, predict, compare

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        The same heater on another day, switched off after 1.5 h:

        >>> times = np.linspace(0.5, 6.0, 12)
        >>> exact = 25 * (1 - np.exp(-0.4 * np.minimum(times, 1.5))) * np.exp(-0.4 * np.maximum(times - 1.5, 0))
        >>> noise = 0.2 * np.random.default_rng(1).normal(size=12)
        >>> found = fit.validate(sf.Measurements(times, exact + noise))
        >>> dict(zip(found.theta_names, found.theta.round(1).tolist()))
        {'tau_1': 1.5, 'k': 0.4}
        >>> found.verdict.level
        'good'
        """
        return validate_on(self, other, refit=refit)

    @cached_property
    def identifiability(self) -> Identifiability:
        """Which combinations of the unknowns the data determine badly, with J evaluated there."""
        return identifiability(self)

    def plot(self, *, bands: bool = True, level: float = 0.95) -> Figure:
        """Draw measured against fitted over time with the modes shaded, as a matplotlib Figure.

        Parameters
        ----------
        bands : bool
            Whether to draw confidence and prediction bands of the fitted values, which need the model and a covariance.
            The first ones of a model take a second to compile.
        level : float, between 0 and 1
            Level of the bands.

        See Also
        --------
        Estimate.plot_residuals, Estimate.predict

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> figure = fit.plot(bands=False)
        >>> len(figure.axes)
        2
        """
        return draw_figure(self, bands=bands, level=level)

    @property
    def residuals(self) -> ResidualDiagnostics:
        """Tests of the residuals, channel by channel: whiteness, effective sample size."""
        return diagnose(self)

    def plot_residuals(self) -> Figure:
        """Draw residuals in time, their autocorrelation and their quantiles, as a matplotlib Figure.

        See Also
        --------
        Estimate.residuals, Estimate.plot

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> len(fit.plot_residuals().axes)
        3
        """
        return draw_figure(self.residuals)

    def plot_convergence(self, *, ax: Drawn | None = None) -> Drawn:
        """Draw the optimality against iteration on a logarithmic scale, with the tolerance.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Axes to draw in, which are returned; without them, a Figure is made and returned.

        See Also
        --------
        Estimate.plot, Estimate.profile

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> fit.plot_convergence().axes[0].get_xlabel()
        'iteration'
        """
        return draw_figure(self, what="convergence", ax=ax)

    def plot_timeline(self, *, level: float = 0.95, ax: Drawn | None = None) -> Drawn:
        """Draw which mode is active when, a row for each experiment, with intervals of the transition times.

        Parameters
        ----------
        level : float, between 0 and 1
            Of the intervals.
        ax : matplotlib.axes.Axes, optional
            Axes to draw in, which are returned; without them, a Figure is made and returned.

        See Also
        --------
        Estimate.plot, Estimate.profile

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> [text.get_text() for text in fit.plot_timeline().axes[0].texts]
        ['on', 'off']
        """
        return draw_figure(self, what="timeline", level=level, ax=ax)

    def plot_plane(
        self,
        *,
        channels: tuple[str, str] | None = None,
        experiment: int = 0,
        ax: Drawn | None = None,
    ) -> Drawn:
        """Draw the path in the plane where two positions are measured.

        Parameters
        ----------
        channels : (str, str), optional
            Names of the two positions; left out, they are told by names such as X and Y or east and north.
        experiment : int
        ax : matplotlib.axes.Axes, optional
            Axes to draw in, which are returned; without them, a Figure is made and returned.

        Raises
        ------
        ValueError
            If no two channels are positions in a plane, or those that are named do not exist.

        See Also
        --------
        Estimate.plot, Estimate.profile

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> try:  # a drive with two positions has such a figure, a room with one thermometer has none
        ...     fit.plot_plane()
        ... except ValueError as error:
        ...     print(str(error).partition(";")[0])
        no two channels of the same data are positions in a plane by their names
        """
        return draw_figure(self, what="plane", channels=channels, experiment=experiment, ax=ax)

    def save(self, path: str | Path, *, provenance: Provenance | None = None) -> None:
        """Write everything but the model to a JSON file, atomically; `load` reads it.

        Parameters
        ----------
        path : path
        provenance : Provenance, optional
            What the fit was made from, ``load_problem("problem.toml").provenance``, from which ``switchfit validate``
            and ``compare`` build the problem again. Left out, the file keeps versions.

        See Also
        --------
        Estimate.load

        Examples
        --------
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> fit = sf.estimate(heater_problem())

        >>> with TemporaryDirectory() as folder:
        ...     fit.save(Path(folder) / "fit.json")
        ...     (Path(folder) / "fit.json").read_text().splitlines()[1]
        '  "verdict": {'
        """
        file = as_path(path, "path")
        save_fit(self.complete(), self.certificate, file, self.describe_provenance(provenance))

    def describe_provenance(self, given: Provenance | None = None) -> Provenance | None:
        """Return what the file of the estimate keeps of its origin; None for one that was loaded from a file without.

        Parameters
        ----------
        given : Provenance, optional
            Of its problem file.

        See Also
        --------
        Estimate.save

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> sorted(fit.describe_provenance().versions)[:3]
        ['Python', 'daqp', 'jax']
        """
        if given is not None:
            return as_instance(given, "provenance", Provenance, "the provenance of a problem file")
        return self.provenance if self.saved_certificate is not None else Provenance()

    def save_report(self, path: str | Path, *, provenance: Provenance | None = None) -> None:
        """Write the report as one HTML file, atomically: figures to zoom into, a slider for each unknown, the inputs.

        It needs no network and no other file. `switchfit fit --out` writes it too.

        Parameters
        ----------
        path : path
            Such as "report.html".
        provenance : Provenance, optional
            As for `Estimate.save`: the text of the problem file goes into the report, with the hashes of the files that
            it names.

        Raises
        ------
        ImportError
            Without the libraries of the extra `report`, with the command that installs them.

        See Also
        --------
        Estimate.report, Estimate.plot, Estimate.save

        Examples
        --------
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> fit = sf.estimate(heater_problem())

        >>> with TemporaryDirectory() as folder:
        ...     fit.save_report(Path(folder) / "report.html")
        ...     (Path(folder) / "report.html").read_text().splitlines()[0]
        '<!DOCTYPE html>'
        """
        file = as_path(path, "path")
        write_atomically(format_page(self, provenance=provenance), file)

    def to_pandas(self, what: TableKind = "unknowns") -> pandas.DataFrame:
        """Return one of the tables of the fit as a DataFrame; units are in ``.attrs["units"]``.

        Parameters
        ----------
        what : {"unknowns", "trajectories", "residuals", "history"}
            A row for each unknown, with its standard error and 95 % interval; for each node of each run; for each value
            that was measured; for each iteration.

        Raises
        ------
        ImportError
            If pandas is not installed.

        See Also
        --------
        Trajectory.to_pandas, Fits.to_pandas

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> fit.to_pandas()[["value", "std_error"]].round(3).to_dict("index")
        {'tau_1': {'value': 2.462, 'std_error': 0.018}, 'k': {'value': 0.393, 'std_error': 0.005}}
        >>> fit.to_pandas("residuals").shape
        (24, 6)
        """
        return build_pandas(describe_frame(self, what=as_choice(what, "what", ESTIMATE_TABLES)))

    def complete(self) -> Estimate:
        """Return the estimate with all fields that are saved: computes the Gauss-Newton matrix, and the profiles of
        transition times with samples near.

        See Also
        --------
        Estimate.save

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> fit.complete().saved_pieces.shape[0]
        1
        """
        pieces, places = self._trace_profiles()
        matrix = self.gauss_newton
        return replace(self, saved_gauss_newton=matrix, saved_pieces=pieces, saved_piece_places=places)

    @classmethod
    def load(cls, path: str | Path, *, problem: Problem | None = None) -> Estimate:
        """Read what `save` wrote: every field is equal, and arrays have the same bits, dtype and shape.

        Parameters
        ----------
        path : path
        problem : Problem, optional
            The problem that was fitted, needed for profiles and predictions: a file does not contain the model.

        Raises
        ------
        OSError
            If there is no such file (FileNotFoundError) or it cannot be read.
        ValueError
            If it is not valid JSON, not written by switchfit, of another version, or not as it was written, or the
            problem has other unknowns or other time units.

        See Also
        --------
        Estimate.save

        Examples
        --------
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> fit = sf.estimate(heater_problem())

        >>> with TemporaryDirectory() as folder:
        ...     fit.save(Path(folder) / "fit.json")
        ...     loaded = sf.Estimate.load(Path(folder) / "fit.json", problem=heater_problem())
        >>> bool((loaded.theta == fit.theta).all())
        True
        """
        file = as_path(path, "path")
        content = read_document(file, "a saved estimate", FIT_FORMAT, FIT_VERSION)
        try:
            fit, certificate = parse_fit(content)
            found = Estimate(**vars(fit), saved_certificate=certificate)
            provenance = from_json(Provenance | None, content.get("provenance"), "provenance")
        except (ValueError, OverflowError, RecursionError, MemoryError) as error:
            raise ValueError(f"{path} is damaged: {error}.") from error
        if provenance is not None and provenance.folder:
            folder = os.path.normpath(file.resolve().parent / provenance.folder)
            provenance = replace(provenance, folder=folder)
        if problem is not None:
            _check_loaded(found, problem, path)
        return replace(found, problem=problem, provenance=provenance)


def _check_loaded(fit: Fit, problem: Problem, path: str | Path) -> None:
    """Raise ValueError unless a fit that was loaded from a file may be that of a problem."""
    as_instance(problem, "problem", Problem, "an sf.Problem")
    if problem.theta_names != fit.theta_names:
        raise ValueError(
            f"{path} holds the unknowns {', '.join(fit.theta_names)}, the problem has "
            f"{', '.join(problem.theta_names)}: it is the fit of another problem."
        )
    runs = fit.trajectories, problem.experiments
    clocks = [[(run.time_unit, run.origin and run.origin.instant) for run in each] for each in runs]
    if clocks[0] != clocks[1]:
        saved, given = (", ".join(map(_describe_clock, each)) for each in runs)
        raise ValueError(
            f"{path} holds times in {saved}, the problem has them in {given}, and times are not converted: give the "
            "problem's experiments the time_unit and the origin of the file."
        )


def _describe_clock(run: Trajectory | Experiment) -> str:
    return run.time_unit if run.origin is None else f"{run.time_unit} since {run.origin.date}"
