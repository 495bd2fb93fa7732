"""Estimate: the result of a fit, with methods for uncertainty, prediction, figures and files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from numpy.typing import ArrayLike

from switchfit.io.provenance import Provenance
from switchfit.io.saved_fits import load_fit, save_fit
from switchfit.problem.problem import Problem
from switchfit.problem.validation.names import as_choice
from switchfit.problem.validation.objects import as_flag, as_instance, as_path
from switchfit.runtime.files import write_atomically
from switchfit.runtime.frames import Tabular, build_pandas, describe_frame
from switchfit.runtime.presentation import (
    Displayed,
    Drawn,
    Figure,
    draw_figure,
    format_line,
    format_page,
    format_text,
    join_first,
)
from switchfit.runtime.progress import Progress
from switchfit.strategy.validation import Validation, validate
from switchfit.uncertainty.judged_fit import JudgedFit
from switchfit.uncertainty.prediction import Prediction, predict
from switchfit.uncertainty.profiles import Profile, profile

if TYPE_CHECKING:
    import pandas

TableKind = Literal["unknowns", "trajectories", "residuals", "history"]
ESTIMATE_TABLES = get_args(TableKind)


@dataclass(frozen=True, eq=False)
class Estimate(JudgedFit, Tabular, Displayed):
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

    provenance: Provenance | None = None

    def __repr__(self) -> str:
        unknowns = (f"{name} = {value:.4g}" for name, value in zip(self.theta_names, self.theta, strict=True))
        return format_line(self, self.verdict.level, f"J = {self.cost:.6g}", join_first(unknowns))

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

    def validate(self, other: Any, *, refit: Sequence[str] | None = None) -> Validation:
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
        found = validate(self, other, refit=refit)
        # The room below knows fits without a facade; what comes out here has its methods.
        return found if found.refit is None else replace(found, refit=Estimate.take_over(found.refit))

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
        # A loaded fit keeps what it was made from; one that was made here is of these versions.
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
        fit, certificate, provenance = load_fit(path, problem)
        found = cls.take_over(fit)
        return replace(found, saved_certificate=certificate, problem=problem, provenance=provenance)
