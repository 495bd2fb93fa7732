"""Many fits of one model, as arrays with one entry a fit, and the verdict on them.

`Fits` is what `estimate_many` returns, and what the results of Monte Carlo studies, bootstraps and multistarts are
made of. It has nothing of the models: levels, intervals and doubts follow from the arrays, so that a file of them is
as good as the run itself.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self, get_type_hints

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.batch.archives import read_arrays, write_arrays
from switchfit.batch.doubts import find_doubts, has_converged
from switchfit.batch.ends import Ends
from switchfit.batch.fits_archive import FITS_FORMAT, FITS_VERSION, describe_best, load_best, split_fields
from switchfit.estimation.estimates import Estimate
from switchfit.fit.statistics import interval, measure_quantile, measure_variance
from switchfit.problem.origin import Origin
from switchfit.problem.validation.arrays import as_level
from switchfit.problem.validation.objects import as_path
from switchfit.runtime.frames import Tabular
from switchfit.runtime.issue import Issue
from switchfit.runtime.json_documents import parse_document
from switchfit.runtime.json_records import from_json, to_json
from switchfit.runtime.presentation import Displayed, Figure, draw_figure, format_line, join_first
from switchfit.uncertainty import doubts as doubts_module
from switchfit.uncertainty.doubts import VERDICT_LEVELS, Doubt, Level
from switchfit.uncertainty.explained_variance import HALF
from switchfit.uncertainty.findings import Finding
from switchfit.uncertainty.profile_pieces import replace_intervals
from switchfit.uncertainty.verdict import Verdict


@dataclass(frozen=True, eq=False)
class Fits(Ends, Tabular, Displayed):
    """Many fits of one model; R of them, d unknowns in the order of `theta_names`.

    Attributes
    ----------
    theta_names, theta_units : tuple of str
    requested : int
        Fits that were asked for; more than R if it was stopped.
    runs : (R,) int
        Number of each fit, from 0.
    start, theta : (R, d)
    cost : (R,)
    gradient, hessian : (R, d), (R, d, d)
    optimality : (R,)
    iterations, evaluations : (R,) int
    status : (R,) str
        Name of the `Status` of each.
    message : (R,) str
        A sentence with a remedy where a fit is not an ordinary minimum, otherwise empty.
    free : (R,) int
        Directions that constraints and kinks leave free.
    kinks : (R, d, 2)
        Derivatives of J to the left and right of an unknown that ended at a kink; 0 for others.
    covariance : (R, d, d)
        As `Estimate.covariance`; NaN where the cost has no noise model.
    samples : (R,) int
        Measured values that are not missing.
    explained : (R,)
        Share of the variance of all data together that each explains; NaN where J is not half a sum of squares.
    collapsed : (R,) int
        Modes that last no longer than they must.
    at_bounds : (R,) int
        Parameters and initial states at a bound.
    pieces : (R, T, 2, P, 5)
        Of T transition times with samples within their intervals or at a kink, the profile of J between these samples
        to both sides: where it starts and stops, by how much it exceeds J, slope, curvature. NaN elsewhere.
    piece_places : (T,) int
        Where in theta these transition times stand.
    sigma_known : bool or None
        Whether the noise of the measurements is known; None where the cost has no noise model.
    priors : int
        Unknowns with a prior, which counts as a sample.
    log_scaled : tuple of str
        Unknowns that were estimated on a logarithmic scale.
    log_origins : (d,)
        From where these logarithms count: t0 for a transition time, otherwise 0.
    seconds : float
        Wall time of all.
    date_origins : tuple of Origin or None, d of them
        The date at which a time that is a date is 0; None for other unknowns, and where it is not the same in all fits.

    See Also
    --------
    estimate_many, monte_carlo, multistart, bootstrap

    Examples
    --------
    >>> fits = sf.estimate_many([heater_problem(), heater_problem()])
    >>> len(fits), fits.success, fits.verdict.level
    (2, array([ True,  True]), 'good')
    >>> fits.theta.round(3)
    array([[2.462, 0.393],
           [2.462, 0.393]])
    """

    theta_names: tuple[str, ...]
    theta_units: tuple[str, ...]
    requested: int
    runs: NDArray[np.intp]
    start: FloatArray
    samples: NDArray[np.int64]
    explained: FloatArray
    collapsed: NDArray[np.int64]
    at_bounds: NDArray[np.int64]
    pieces: FloatArray
    piece_places: NDArray[np.intp]
    sigma_known: bool | None
    priors: int
    log_scaled: tuple[str, ...]
    log_origins: FloatArray
    seconds: float
    date_origins: tuple[Origin | None, ...]

    def __repr__(self) -> str:
        levels = (f"{np.sum(self.levels == level)} {level}" for level in ("good", "doubtful", "bad"))
        shown = [text for text in levels if not text.startswith("0 ")]
        return format_line(
            self, f"{len(self)} fit{'' if len(self) == 1 else 's'}", *shown, join_first(self.theta_names)
        )

    def __len__(self) -> int:
        """Number of fits that were done."""
        return len(self.cost)

    @cached_property
    def verdict(self) -> Verdict:
        """Whether to believe them: how many are good, doubtful and bad, why, and what to do next. Print it for a line.

        Each fit is judged by how it ended and by chi-square or the share of the variance that it explains; residuals
        are not tested for correlation, nor channels one by one. `Estimate.verdict` does that for a single fit.
        """
        return _judge_many(self)

    @cached_property
    def levels(self) -> NDArray[np.str_]:
        """The level of each fit, "good", "doubtful" or "bad": (R,)."""
        return doubts_module.find_levels(self.doubts, len(self))

    @cached_property
    def doubts(self) -> list[Doubt]:
        """What speaks against which of them, in order of weight."""
        return find_doubts(vars(self), self.sigma_known, self.priors)

    @cached_property
    def success(self) -> NDArray[np.bool_]:
        """Which of them converged, by `Status.successful`, however well they fit: (R,). See `levels`."""
        return has_converged(self.status)

    @property
    def failures(self) -> list[tuple[int, str]]:
        """Number and message of each fit that did not converge."""
        return [(int(self.runs[k]), str(self.message[k])) for k in np.flatnonzero(~self.success)]

    @property
    def standard_errors(self) -> FloatArray:
        """Square roots of the variances: (R, d)."""
        with np.errstate(invalid="ignore"):
            return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    def confidence_intervals(self, level: float = 0.95) -> FloatArray:
        """Return intervals theta +- quantile x standard error of each fit: (R, d, 2).

        Of a transition time with a few samples near, or at a kink, the profile is followed from sample to sample, as by
        `Estimate.confidence_intervals`. NaN for an unknown that is held by a bound or a collapsed mode.

        See Also
        --------
        Estimate.confidence_intervals, MonteCarlo.coverage

        Examples
        --------
        >>> fits = sf.estimate_many([heater_problem()])
        >>> fits.confidence_intervals(0.9).round(2)
        array([[[2.43, 2.49],
                [0.38, 0.4 ]]])
        """
        level = as_level(level)
        # At least 1: below that Student's t has no quantile.
        freedom = np.maximum(self.samples + self.priors - self.free, 1)
        quantile = measure_quantile(level, freedom, self.sigma_known)
        half = quantile[:, None] * self.standard_errors
        log = np.isin(self.theta_names, self.log_scaled)
        # A standard error of 0 is that of an unknown which is held, not of one that is known exactly.
        found = interval(self.theta, np.where(half > 0, half, np.nan), log, self.log_origins)
        # J may rise by half the squared quantile, in units of the noise: where there are pieces, these say how far that
        # is.
        thresholds = 0.5 * quantile**2 * measure_variance(self.cost, freedom, self.sigma_known)
        return replace_intervals(found, self.pieces, self.piece_places, thresholds)

    @property
    def worst_first(self) -> NDArray[np.intp]:
        """Places of the fits, (R,): bad ones, then doubtful ones, then good ones; of each the largest misfit first.

        The misfit is the cost per sample; fits that did not converge come before all others.
        """
        ranks = np.array([VERDICT_LEVELS.index(level) for level in self.levels.tolist()], dtype=np.intp)
        misfit = self.cost / np.maximum(self.samples, 1)
        # The last key counts most: failed fits first, then by level, then by misfit.
        return np.lexsort((-np.nan_to_num(misfit, nan=np.inf), -ranks, self.success))

    def plot(self) -> Figure:
        """Draw the unknowns: of each fit with its 95 % interval, the worst fits first; of a study or a bootstrap a
        histogram of the estimates, with the truth or the bootstrap's interval.

        See Also
        --------
        Fits.worst_first, Fits.to_pandas

        Examples
        --------
        >>> fits = sf.estimate_many([heater_problem(), heater_problem()])

        >>> [axes.get_xlabel() for axes in fits.plot().axes]
        ['tau_1 (h)', 'k (1/h)']

        >>> len(sf.monte_carlo(heater_problem(), 20, theta=[2.5, 0.4]).plot().axes)
        2
        """
        figure: Figure = draw_figure(self)
        return figure

    def save(self, path: str | Path) -> None:
        """Write all fits to one file, atomically: a NumPy archive that `load` reads.

        See Also
        --------
        Fits.load, Fits.to_pandas

        Examples
        --------
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> fits = sf.estimate_many([heater_problem(), heater_problem()])

        >>> with TemporaryDirectory() as folder:
        ...     fits.save(Path(folder) / "fits.npz")
        ...     loaded = sf.Fits.load(Path(folder) / "fits.npz")
        >>> bool((loaded.theta == fits.theta).all())
        True
        """
        kind, file = type(self), as_path(path, "path")
        arrays, rest = split_fields(kind)
        content = {"format": FITS_FORMAT, "version": FITS_VERSION, "kind": kind.__name__, "fits": to_json(self, rest)}
        if isinstance(best := getattr(self, "best", None), Estimate):
            content["best"] = describe_best(best)
        # Everything that is no array is JSON, as bytes in one more array: nothing in the archive is pickled.
        header = np.frombuffer(json.dumps(content, allow_nan=False).encode(), dtype=np.uint8)
        write_arrays({name: getattr(self, name) for name in arrays} | {"header": header}, file)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what `save` wrote; ``sf.Fits.load`` returns whatever kind of fits it was.

        Raises
        ------
        ValueError
            If the file is not one of switchfit's, is damaged, or holds another kind of fits.

        See Also
        --------
        Fits.save

        Examples
        --------
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory

        >>> with TemporaryDirectory() as folder:
        ...     sf.multistart(heater_problem(), 8).save(Path(folder) / "starts.npz")
        ...     loaded = sf.Fits.load(Path(folder) / "starts.npz")
        >>> type(loaded).__name__, loaded.best.status.name
        ('Multistart', 'CONVERGED')
        """
        file = as_path(path, "path")
        arrays, reason = read_arrays(file)
        if reason:
            raise ValueError(f"{file} {'is damaged' if arrays else 'does not hold saved fits'}: {reason}.")
        header = arrays.pop("header", np.zeros(0, np.uint8)).tobytes()
        content = parse_document(header, file, "a file of saved fits", FITS_FORMAT, FITS_VERSION)
        # `Fits.load` reads any kind; `Multistart.load` its own alone.
        kinds = {each.__name__: each for each in (cls, *cls.__subclasses__())}
        if (name := content.get("kind")) not in kinds:
            raise ValueError(
                f"{file} holds the kind of fits {name!r}, not {cls.__name__}: sf.Fits.load reads every kind."
            )
        kind: type[Any] = kinds[name]
        try:
            # The best estimate of a multistart is a saved fit inside the file, which no table of fields describes.
            nested = {"best": load_best(content.get("best"))} if "best" in get_type_hints(kind) else {}
            others = vars(from_json(split_fields(kind)[1], content.get("fits"), "fits"))
            found: Self = kind(**arrays, **others, **nested)
            return found
        except (TypeError, ValueError, OverflowError, RecursionError, MemoryError) as error:
            raise ValueError(f"{file} is damaged: {error}.") from error


def _judge_many(fits: Fits) -> Verdict:
    """Return the verdict on fits of many logs, or of anything in which each fit counts by itself."""
    R, doubts = len(fits), fits.doubts
    counts: dict[str, float] = {level: float(np.sum(fits.levels == level)) for level in VERDICT_LEVELS}
    stopped = list(find_stop(fits))
    if not doubts and not stopped:
        known = np.isfinite(fits.explained)
        if not known.any():
            return Verdict("good", (Issue("many fits", figures=counts),))
        counts |= {"worst": float(fits.explained[known].min()), "median": float(np.median(fits.explained[known]))}
        return Verdict("good", (Issue("many fits", (str(fits.runs[_find_worst(fits, known)]),), counts),))
    level: Level = "bad" if counts["bad"] >= HALF * R else "doubtful"
    reasons = [Issue("many fits", (), counts)] if R > 1 else []
    reasons += [build_reason(fits, doubt) for doubt in doubts] + [finding.reason for finding in stopped]
    steps = [Issue("next: fit alone", (str(fits.runs[_find_worst(fits, doubts[0].which)]),))] if doubts else []
    steps += [Issue(f"next: {step}") for finding in stopped for step in finding.steps]
    if any(doubt.kind == "a mode collapsed" for doubt in doubts):
        steps.append(Issue("next: leave the mode out"))
    return Verdict(level, tuple(reasons), tuple(steps))


def find_stop(fits: Fits) -> Iterator[Finding]:
    """Find out whether the fits were stopped before the last."""
    left = fits.requested - len(fits.status)
    if left > 0:
        figures = {"count": float(left), "fits": float(fits.requested)}
        yield Finding("doubtful", Issue("stopped", figures=figures), ("go on",))


def build_reason(fits: Fits, doubt: Doubt) -> Issue:
    """Return a reason with the number of fits that it is about, the worst of them and how much that explains."""
    figures = {"count": float(doubt.which.sum()), "fits": float(len(doubt.which))}
    if doubt.kind == "not converged":
        # The commonest ending first: it is what a remedy should be about.
        endings = Counter(fits.status[doubt.which].tolist()).most_common()
        return Issue("some not converged", tuple(name for name, _ in endings), figures)
    worst = _find_worst(fits, doubt.which)
    return Issue(f"some {doubt.kind}", (str(fits.runs[worst]),), figures | {"worst": float(fits.explained[worst])})


def _find_worst(fits: Fits, which: NDArray[np.bool_]) -> int:
    """Return the place of the worst of some fits: the one that explains least, if any does."""
    places = np.flatnonzero(which)
    shares = fits.explained[places]
    # No share is known where J is no sum of squares; one is then as bad as any other.
    return int(places[0] if np.isnan(shares).all() else places[np.nanargmin(shares)])
