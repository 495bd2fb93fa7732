"""What many fits found: arrays with one entry a fit; how many are good, doubtful and bad, why, and what to do next.

Ten thousand fits cannot be simulated one by one. Each is judged by what its program returns (status, J, theta, the
Hessian) and by the share of its data's variance that J leaves, by the rules of single fits
(`switchfit.uncertainty.verdict`), as if its residuals could not be tested. Not looked at are the correlation of the
residuals, single channels, other starts, and checks of derivatives: fit one by itself for these.

With J half a sum of squares, and V that of the data about their means, the share of the variance that is explained is
``1 - J / V``. So it needs V once for each data set, where a single fit compares its trajectory channel by channel.

Many fits are saved as one NumPy archive. It holds one array for each array of `Fits` under the name of its field,
``header``, the JSON of everything else (UTF-8 bytes), and ``seal``, a digest of all of these, by which damage is
noticed. Nothing in it is pickled.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, make_dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Self, get_type_hints

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.batch.chunks import read_arrays, write_arrays
from switchfit.batch.program import Ends
from switchfit.estimation.estimator import Estimate, parse_fit, write_fit
from switchfit.fit.result import count_samples, interval, measure_quantile, measure_variance
from switchfit.optimize import Status
from switchfit.problem.experiment import Experiment
from switchfit.problem.origin import Origin
from switchfit.problem.problem import Problem
from switchfit.problem.validation.arrays import as_level
from switchfit.problem.validation.objects import as_path
from switchfit.runtime import special
from switchfit.runtime.frames import Tabular
from switchfit.runtime.issue import Issue
from switchfit.runtime.json_documents import parse_document
from switchfit.runtime.json_records import find_dtype, from_json, to_json
from switchfit.runtime.presentation import Displayed, Figure, draw_figure, format_line, join_first
from switchfit.uncertainty import verdict
from switchfit.uncertainty.certificate import certify
from switchfit.uncertainty.residuals import HALF, UNLIKELY, compare_with_sigma
from switchfit.uncertainty.verdict import FINE, LEVELS, Doubt, Finding, Level, Numbers, Verdict, build_verdict
from switchfit.uncertainty.walks import replace_intervals

FORMAT = "switchfit fits"
VERSION = 3

AT_END = 1e-9
"""Duration of a mode, as a part of the horizon, or distance from a bound, as a part of it, that counts as zero."""

MINOR = 0.01
"""Share of a study's fits that may have failed, or ended at a bound or with a collapsed mode, without a doubt about its
standard deviations and 95 % intervals."""

FAR_AWAY = 10.0
"""Robust standard deviations (1.48 times the median deviation) from the median beyond which a fit of a study has ended
in another minimum. The tails of noise do not reach that far; a single fit that does shows in standard deviations."""

EXPLAINED_BADLY = ("unexplained", "no noise")
"""Doubts that chi-square gives."""

LEVEL = 0.95
"""Level at which a study's intervals are checked against the truth. It is said if they miss it half as often again as
they should (`HALF`), and chance does not explain it."""


def _split_fields(kind: type[Any]) -> tuple[list[str], type[Any]]:
    """Return the names of the arrays of a class, and a dataclass of its other fields without the best estimate."""
    hints = {name: hint for name, hint in get_type_hints(kind).items() if name != "best"}
    declared = [name for name, hint in hints.items() if find_dtype(hint) is not None]
    return declared, make_dataclass(kind.__name__, [item for item in hints.items() if item[0] not in declared])


def describe_best(best: Estimate) -> dict[str, Any]:
    """Return an estimate as the content of its file; without the check by the paper's equations, if it was not done.

    Parameters
    ----------
    best : Estimate
    """
    return write_fit(best.complete(), best.known_certificate or certify(best, None))


def load_best(content: Any) -> Estimate | None:
    """Return the estimate with the content of its file; None if there is none.

    Parameters
    ----------
    content : mapping or None
        As `describe_best` returned it.
    """
    return None if content is None else parse_fit(content)


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
        return judge_many(self)

    @cached_property
    def levels(self) -> NDArray[np.str_]:
        """The level of each fit, "good", "doubtful" or "bad": (R,)."""
        return verdict.find_levels(self.doubts, len(self))

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
        freedom = np.maximum(self.samples + self.priors - self.free, 1)
        quantile = measure_quantile(level, freedom, self.sigma_known)
        half = quantile[:, None] * self.standard_errors
        log = np.isin(self.theta_names, self.log_scaled)
        found = interval(self.theta, np.where(half > 0, half, np.nan), log, self.log_origins)
        thresholds = 0.5 * quantile**2 * measure_variance(self.cost, freedom, self.sigma_known)
        return replace_intervals(found, self.pieces, self.piece_places, thresholds)

    @property
    def worst_first(self) -> NDArray[np.intp]:
        """Places of the fits, (R,): bad ones, then doubtful ones, then good ones; of each the largest misfit first.

        The misfit is the cost per sample; fits that did not converge come before all others.
        """
        ranks = np.array([LEVELS.index(level) for level in self.levels.tolist()], dtype=np.intp)
        misfit = self.cost / np.maximum(self.samples, 1)
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
        arrays, rest = _split_fields(kind)
        content = {"format": FORMAT, "version": VERSION, "kind": kind.__name__, "fits": to_json(self, rest)}
        if isinstance(best := getattr(self, "best", None), Estimate):
            content["best"] = describe_best(best)
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
        content = parse_document(header, file, "a file of saved fits", FORMAT, VERSION)
        kinds = {each.__name__: each for each in (cls, *cls.__subclasses__())}
        if (name := content.get("kind")) not in kinds:
            raise ValueError(
                f"{file} holds the kind of fits {name!r}, not {cls.__name__}: sf.Fits.load reads every kind."
            )
        kind: type[Any] = kinds[name]
        try:
            nested = {"best": load_best(content.get("best"))} if "best" in get_type_hints(kind) else {}
            others = vars(from_json(_split_fields(kind)[1], content.get("fits"), "fits"))
            found: Self = kind(**arrays, **others, **nested)
            return found
        except (TypeError, ValueError, OverflowError, RecursionError, MemoryError) as error:
            raise ValueError(f"{file} is damaged: {error}.") from error


def describe_ends(
    problem: Problem, theta: FloatArray, cost: FloatArray, variation: FloatArray
) -> dict[str, NDArray[Any]]:
    """Return the fields `samples`, `explained`, `collapsed` and `at_bounds` of `Fits`, (R,) each.

    Parameters
    ----------
    problem : Problem
        Its bounds, modes and horizons; its data may differ from those that were fitted.
    theta : (R, d)
    cost : (R,)
    variation : (R,)
        Sum of `switchfit.fit.evaluator.measure_variation` over the experiments.
    """
    unknowns, priors = problem.unknowns, problem.unknowns.priors
    squares = cost - np.array([priors.evaluate(each)[0] for each in theta]) if priors.any else cost
    with np.errstate(divide="ignore", invalid="ignore"):
        explained = np.where(variation == 0, squares <= 0, 1 - squares / variation)
        near = AT_END * np.abs(theta)
        held = (theta <= unknowns.lower + near) | (theta >= unknowns.upper - near)
        held &= ~unknowns.is_time & (unknowns.lower < unknowns.upper)  # equal bounds are a value that is known
        collapsed = sum(map(partial(_count_collapsed, problem), problem.experiments, problem.ends_of_modes(theta)))
    return {
        "samples": np.full(len(cost), count_samples(problem)),
        "explained": np.where(np.isnan(variation) | np.isnan(cost), np.nan, explained),
        "collapsed": np.asarray(collapsed, dtype=np.int64),
        "at_bounds": np.sum(held, axis=1),
    }


def _count_collapsed(problem: Problem, experiment: Experiment, ends: FloatArray) -> NDArray[np.int64]:
    """Return how many modes of an experiment last no longer than they must, from their ends (R, N + 2): (R,)."""
    least = np.array([problem.durations[mode] for mode in experiment.mode_sequence])
    shortest = least + AT_END * (experiment.end - experiment.t0)
    found: NDArray[np.int64] = np.sum(np.diff(ends, axis=1) <= shortest, axis=1)
    return found


def has_converged(status: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which of fits with these names of their `Status` converged: (R,)."""
    return np.isin(status, [one.name for one in Status if one.successful])


def find_doubts(fits: Mapping[str, NDArray[Any]], sigma_known: bool | None, priors: int) -> list[Doubt]:
    """Return what speaks against each of R fits, in order of weight.

    Parameters
    ----------
    fits : mapping of str to array
        Fields of `Fits`: `status`, `cost`, `hessian`, `free`, `samples`, `explained`, `collapsed`, `at_bounds`.
    sigma_known, priors : as of `Fits`
    """
    status, explained, freedom = fits["status"], fits["explained"], fits["samples"] + priors - fits["free"]
    has_noise, has_shares = sigma_known is not None, bool(np.isfinite(explained).any())
    numbers = Numbers(
        has_converged(status),
        explained=explained,
        freedom=freedom if has_noise and has_shares else np.inf,
        collapsed=np.where(status == Status.COLLAPSED.name, 1, fits["collapsed"]),
        at_bounds=fits["at_bounds"] if has_noise or has_shares else 0,
        smallest=_find_smallest(fits["hessian"], fits["free"], status),
        references=not has_noise,
    )
    if has_shares and sigma_known:
        probability, known = compare_with_sigma(2 * fits["cost"], freedom, tests=len(status))
        numbers = replace(numbers, probability=probability, known=known)
    return verdict.find_doubts(numbers)


def judge_many(fits: Fits) -> Verdict:
    """Return the verdict on fits of many logs, or of anything in which each fit counts by itself."""
    R, doubts = len(fits), fits.doubts
    counts: dict[str, float] = {level: float(np.sum(fits.levels == level)) for level in LEVELS}
    stopped = list(_find_stop(fits))
    if not doubts and not stopped:
        known = np.isfinite(fits.explained)
        if not known.any():
            return Verdict("good", (Issue("many fits", figures=counts),))
        counts |= {"worst": float(fits.explained[known].min()), "median": float(np.median(fits.explained[known]))}
        return Verdict("good", (Issue("many fits", (str(fits.runs[_find_worst(fits, known)]),), counts),))
    level: Level = "bad" if counts["bad"] >= HALF * R else "doubtful"
    reasons = [Issue("many fits", (), counts)] if R > 1 else []
    reasons += [_count(fits, doubt) for doubt in doubts] + [finding.reason for finding in stopped]
    steps = [Issue("next: fit alone", (str(fits.runs[_find_worst(fits, doubts[0].which)]),))] if doubts else []
    steps += [Issue(f"next: {step}") for finding in stopped for step in finding.steps]
    if any(doubt.kind == "a mode collapsed" for doubt in doubts):
        steps.append(Issue("next: leave the mode out"))
    return Verdict(level, tuple(reasons), tuple(steps))


def judge_study(
    fits: Fits,
    *,
    truth: FloatArray | None = None,
    error: float = 0.0,
    origin: Verdict | None = None,
    considered: NDArray[np.bool_] | None = None,
) -> Verdict:
    """Return the verdict on fits whose spread is what they are for.

    Parameters
    ----------
    fits : Fits
    truth : (d,), optional
        What all of them should find.
    error : float
        Integration error of J, relative.
    origin : Verdict, optional
        On the fit that the data are made of.
    considered : (d,) bool, optional
        Unknowns whose spread means something; all if left out.
    """
    R, ended = len(fits.status), fits.success
    shared = np.ones(len(fits.theta_names), dtype=bool) if considered is None else considered
    found: list[Finding] = []
    if origin is not None and origin.level == "bad":
        found.append(Finding("bad", Issue("resampled fit", (origin.level,)), ("look at the fit",)))
    failed = int(R - ended.sum())
    if failed > MINOR * R:
        level: Level = "bad" if failed >= HALF * R else "doubtful"
        found.append(Finding(level, _count(fits, Doubt("not converged", level, ~ended)), ("see failures",)))
    distances = measure_distances(fits, shared)
    elsewhere = distances > FAR_AWAY
    if elsewhere.any():
        farthest = str(fits.runs[int(np.argmax(distances))])
        figures = {"count": float(elsewhere.sum()), "fits": float(R)}
        found.append(Finding("doubtful", Issue("ended elsewhere", (farthest,), figures), ("take quantiles",)))
    for doubt in fits.doubts:
        many = doubt.which.sum() > MINOR * R
        if doubt.kind in ("a mode collapsed", "at bounds", "not determined") and many:
            step = "leave the mode out" if doubt.kind == "a mode collapsed" else "take quantiles"
            found.append(Finding("doubtful", _count(fits, doubt), (step,)))
        elif doubt.kind in EXPLAINED_BADLY and origin is None and np.any(doubt.which & ~elsewhere):
            found.append(Finding("doubtful", _count(fits, doubt), ("check sigma",)))
    if truth is not None:
        found += _check_coverage(fits, truth, ended & ~elsewhere)
    if not error <= FINE:
        found.append(Finding("bad", Issue("integration error", ("J",), {"error": error}), ("smaller rtol",)))
    found += _find_stop(fits)
    figures = {"count": float(ended.sum()), "fits": float(R)}
    return build_verdict(found or [Finding("good", Issue("study", figures=figures))])


def judge_starts(fits: Fits, best: Verdict | None) -> Verdict:
    """Return the verdict on fits from many starts: that on the best end, and whether starts are left.

    Parameters
    ----------
    fits : Fits
    best : Verdict or None
        None where no start could be fitted to the end.
    """
    if best is None:
        everywhere = Doubt("not converged", "bad", np.ones(len(fits), dtype=bool))
        best = Verdict("bad", (_count(fits, everywhere),), (Issue("next: start elsewhere"),))
    for stop in _find_stop(fits):
        level, against = (stop.level, ()) if best.level == "good" else (best.level, best.reasons)
        best = Verdict(level, (*against, stop.reason), (*best.next_steps, Issue("next: go on")), best.answers)
    return best


def measure_distances(fits: Fits, considered: NDArray[np.bool_]) -> FloatArray:
    """Return how far fits converged from the others, in spreads; 0 for those that did not converge: (R,).

    An unknown's deviation from the median is measured by the median of these deviations, or by the median standard
    error, or 1e-3 of the unknown's size where most are held. Of some unknowns (d,), the largest counts.
    """
    ended = fits.success
    found = np.zeros(len(ended))
    if ended.sum() < 3:
        return found
    theta = fits.theta[ended]
    centre = np.median(theta, axis=0)
    deviation = np.abs(theta - centre)
    errors = fits.standard_errors[ended]
    usual = np.array([np.median(e[np.isfinite(e)]) if np.isfinite(e).any() else 0.0 for e in errors.T])
    spread = np.maximum(1.4826 * np.median(deviation, axis=0), usual)
    spread = np.where(spread > 0, spread, 1e-3 * np.maximum(np.abs(centre), 1e-300))
    found[ended] = np.max(deviation / spread * considered, axis=1)
    return found


def _find_smallest(H: FloatArray, free: NDArray[np.int64], status: NDArray[np.str_]) -> FloatArray:
    """Return the smallest eigenvalue of each scaled Hessian, infinite where a constraint is active: (R,)."""
    found = np.where(status == Status.SINGULAR.name, 0.0, np.inf)
    diagonal = np.diagonal(H, axis1=1, axis2=2)
    whole = (free == H.shape[1]) & np.isfinite(H).all(axis=(1, 2)) & (diagonal > 0).all(axis=1)
    if whole.any():
        scale = diagonal[whole] ** -0.5
        smallest = np.linalg.eigvalsh(H[whole] * scale[:, :, None] * scale[:, None, :])[:, 0]
        found[whole] = np.minimum(found[whole], smallest)
    return found


def _check_coverage(fits: Fits, truth: FloatArray, counted: NDArray[np.bool_]) -> Iterator[Finding]:
    """Find unknowns whose intervals hold the truth less often than they should."""
    low, high = np.moveaxis(fits.confidence_intervals(LEVEL)[counted], 2, 0)
    known = ~np.isnan(low).all(axis=0) if len(low) else np.zeros(low.shape[1], dtype=bool)
    if not known.any():
        return
    n = len(low)
    inside = np.sum((low <= truth) & (truth <= high), axis=0)
    chance = special.bdtr(inside, n, LEVEL)  # of so few, or fewer
    short = known & (n - inside > (1 + HALF) * (1 - LEVEL) * n) & (chance < UNLIKELY / len(truth))
    if short.any():
        order = np.argsort(np.where(short, inside, n + 1), kind="stable")[: short.sum()]
        names = tuple(fits.theta_names[i] for i in order)
        shares = {"share": float(inside[order[0]] / n), "level": LEVEL}
        yield Finding("doubtful", Issue("intervals too short", names, shares), ("profiles",))


def _find_stop(fits: Fits) -> Iterator[Finding]:
    """Find out whether the fits were stopped before the last."""
    left = fits.requested - len(fits.status)
    if left > 0:
        figures = {"count": float(left), "fits": float(fits.requested)}
        yield Finding("doubtful", Issue("stopped", figures=figures), ("go on",))


def _count(fits: Fits, doubt: Doubt) -> Issue:
    """Return a reason with the number of fits that it is about, the worst of them and how much that explains."""
    figures = {"count": float(doubt.which.sum()), "fits": float(len(doubt.which))}
    if doubt.kind == "not converged":
        endings = Counter(fits.status[doubt.which].tolist()).most_common()
        return Issue("some not converged", tuple(name for name, _ in endings), figures)
    worst = _find_worst(fits, doubt.which)
    return Issue(f"some {doubt.kind}", (str(fits.runs[worst]),), figures | {"worst": float(fits.explained[worst])})


def _find_worst(fits: Fits, which: NDArray[np.bool_]) -> int:
    """Return the place of the worst of some fits: the one that explains least, if any does."""
    places = np.flatnonzero(which)
    shares = fits.explained[places]
    return int(places[0] if np.isnan(shares).all() else places[np.nanargmin(shares)])
