"""What many fits found: arrays with one entry a fit. One model, many logs: every log a problem of its own.

Save many fits as one NumPy archive, and load them without losing a bit.

A file holds one array for each array of `Fits` under the name of its field, ``header``, the JSON of everything else
(UTF-8 bytes), and ``seal``, a digest of all of these, by which damage is noticed. Nothing in it is pickled.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, make_dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Self, get_type_hints

import numpy as np
from numpy.typing import NDArray

from switchfit.batch.chunks import read_arrays, run_chunks, write_arrays
from switchfit.batch.program import Limits
from switchfit.batch.study import StudyOfLogs, list_places
from switchfit.batch.verdict import count_priors, find_doubts, has_converged, judge_many, measure_variance
from switchfit.estimation.estimator import Estimate, parse_fit, write_fit
from switchfit.estimation.local_fit import check_settings
from switchfit.fit.evaluator import evaluator_of
from switchfit.fit.result import interval, measure_quantile
from switchfit.fit.solution import refuse_hidden_switches
from switchfit.problem.data import FloatArray
from switchfit.problem.dates import Origin
from switchfit.problem.problem import Problem, require_estimable
from switchfit.problem.validation import as_callable, as_instance, as_level, as_path, as_sequence, join_names
from switchfit.runtime.files import find_dtype, from_json, to_json
from switchfit.runtime.frames import Tabular
from switchfit.runtime.presentation import Displayed, Drawn, draw_figure, format_line, join_first
from switchfit.runtime.progress import show_progress
from switchfit.uncertainty.certificate import certify
from switchfit.uncertainty.verdict import LEVELS, Doubt, Verdict, find_levels
from switchfit.uncertainty.walks import replace_intervals

FORMAT = "switchfit fits"
VERSION = 2


def _read_archive(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the arrays of a file and its header; ValueError if it was not written by `Fits.save` as it is."""
    arrays, reason = read_arrays(path)
    if arrays and reason:
        raise ValueError(f"{path} is damaged: {reason}.")
    try:
        content = json.loads(arrays.pop("header").tobytes())
        if content["format"] != FORMAT:
            reason = f"its header has no format {FORMAT!r}"
    except (KeyError, TypeError, ValueError, RecursionError):
        reason = reason or "it has no header"
    if reason:
        raise ValueError(f"{path} does not hold saved fits ({reason}).")
    return arrays, content


def _build_fits(kind: type[Any], arrays: dict[str, NDArray[Any]], content: dict[str, Any]) -> Any:
    """Return fits of a kind from the content of a file."""
    _, rest = _split_fields(kind)
    nested = {"best": load_best(content.get("best"))} if "best" in get_type_hints(kind) else {}
    return kind(**arrays, **vars(from_json(rest, content.get("fits"), "fits")), **nested)


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
    if content is None:
        return None
    if not isinstance(content, Mapping):
        raise ValueError("best must be an object")
    fit, certificate = parse_fit(content)
    return Estimate(**vars(fit), saved_certificate=certificate)


@dataclass(frozen=True, eq=False)
class Fits(Tabular, Displayed):
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
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
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
    theta: FloatArray
    cost: FloatArray
    gradient: FloatArray
    hessian: FloatArray
    optimality: FloatArray
    iterations: NDArray[np.int64]
    evaluations: NDArray[np.int64]
    status: NDArray[np.str_]
    message: NDArray[np.str_]
    free: NDArray[np.int64]
    covariance: FloatArray
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
        return find_levels(self.doubts, len(self))

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
        `Estimate.confidence_intervals`. NaN for any other unknown that is held.

        See Also
        --------
        Estimate.confidence_intervals, MonteCarlo.coverage

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
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

    def plot(self, *, unknown: str | None = None, ax: Drawn | None = None) -> Drawn:
        """Draw the unknowns: of each fit with its 95 % interval, the worst fits first; of a study or a bootstrap a
        histogram of the estimates, with the truth or the bootstrap's interval.

        Parameters
        ----------
        unknown : str, optional
            The only one that is drawn; left out, all, or some of many.
        ax : matplotlib.axes.Axes, optional
            Axes to draw in, which are returned; without them, a Figure is made and returned. They take one unknown.

        See Also
        --------
        Fits.worst_first, Fits.to_pandas

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
        >>> fits = sf.estimate_many([heater_problem(), heater_problem()])

        >>> [axes.get_xlabel() for axes in fits.plot().axes]
        ['tau_1 (h)', 'k (1/h)']

        >>> len(sf.monte_carlo(heater_problem(), 20, theta=[2.5, 0.4]).plot().axes)
        2
        """
        return draw_figure(self, unknown=unknown, ax=ax)

    def save(self, path: str | Path) -> None:
        """Write all fits to one file, atomically: a NumPy archive that `load` reads.

        See Also
        --------
        Fits.load, Fits.to_pandas

        Examples
        --------
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
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
        write_arrays({name: getattr(self, name) for name in arrays} | {"header": header}, file, np.savez_compressed)

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
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem

        >>> with TemporaryDirectory() as folder:
        ...     sf.multistart(heater_problem(), 8).save(Path(folder) / "starts.npz")
        ...     loaded = sf.Fits.load(Path(folder) / "starts.npz")
        >>> type(loaded).__name__, loaded.best.status.name
        ('Multistart', 'CONVERGED')
        """
        file = as_path(path, "path")
        arrays, content = _read_archive(file)
        version, name = content.get("version"), content.get("kind")
        if version != VERSION:
            raise ValueError(
                f"{file} holds fits in version {version!r} of their format; this switchfit reads version {VERSION}. "
                "Read it with the switchfit that wrote it."
            )
        kinds = {each.__name__: each for each in (cls, *cls.__subclasses__())}
        if name not in kinds:
            raise ValueError(
                f"{file} holds the kind of fits {name!r}, not {cls.__name__}: sf.Fits.load reads every kind."
            )
        try:
            return _build_fits(kinds[name], arrays, content)
        except (TypeError, ValueError, OverflowError, RecursionError, MemoryError) as error:
            raise ValueError(f"{file} is damaged: {error}.") from error


class LongRun(NamedTuple):
    """When fits end, where a long run is done and kept, who is told how far it is, and when it began.

    Attributes
    ----------
    limits : Limits
    client, folder : as of `run_chunks`
    callback : callable ``(done, total)``, a true value stops; or None
    began : float
        As of ``time.perf_counter()``.
    """

    limits: Limits
    client: Any
    folder: str | Path | None
    callback: Callable[[int, int], object] | None
    began: float

    @classmethod
    def check(cls, tolerance: Any, max_iterations: Any, client: Any, folder: Any, callback: Any) -> LongRun:
        """Return these settings; raise for those of the wrong type, before anything long is done."""
        limits = Limits(*check_settings(tolerance, max_iterations))
        if client is not None and not hasattr(client, "submit"):
            raise TypeError(f"client must be a dask.distributed.Client; got {type(client).__name__}.")
        if folder is not None:
            as_path(folder, "folder")
        if callback is not None:
            as_callable(callback, "callback", "a function callback(done, total)", arguments=2)
        return cls(limits, client, folder, callback, time.perf_counter())


def repeat(problem: Problem, work: Any, count: int, title: str, how: LongRun) -> dict[str, Any]:
    """Do `count` runs with a bar on the terminal: the fields of `Fits`.

    Parameters
    ----------
    problem : Problem
        One of those that are fitted: its names, and whether its noise is known.
    work, count : as of `run_chunks`
    title : str
        Of the bar.
    how : LongRun

    Raises
    ------
    ValueError
        For a problem with a switch that is hidden in a function, with which no fit could be right.
    """
    _refuse_hidden_switches(problem)
    with show_progress(how.callback, title) as progress:
        runs, arrays = run_chunks(work, count, client=how.client, folder=how.folder, progress=progress)
    known, priors, unknowns = problem.is_sigma_known, count_priors(problem), problem.unknowns
    variance = measure_variance(arrays["cost"], arrays["samples"] + priors - arrays["free"], known)
    return arrays | {
        "covariance": variance[:, None, None] * arrays["covariance"],
        "theta_names": problem.theta_names,
        "theta_units": unknowns.units,
        "requested": count,
        "runs": runs,
        "sigma_known": known,
        "priors": priors,
        "piece_places": list_places(problem),
        "log_scaled": unknowns.log_names,
        "log_origins": unknowns.origin,
        "seconds": time.perf_counter() - how.began,
        "date_origins": list_origins(problem),
    }


def _refuse_hidden_switches(problem: Problem) -> None:
    """Raise what `estimate` would raise about the model, before thousands of fits list it one by one."""
    try:
        evaluator, theta = evaluator_of(problem), problem.initial_theta
        gradient = evaluator(theta).gradient
    except Exception:  # a guess at which the model cannot be evaluated: the fits that begin there will say so
        return
    if np.isfinite(gradient).all():
        refuse_hidden_switches(evaluator, theta, gradient)


def list_origins(problem: Problem) -> tuple[Origin | None, ...]:
    """Return the date at which each unknown that is a date is 0; None for every other."""
    found: list[Origin | None] = [None] * len(problem.theta_names)
    for experiment, places in zip(problem.experiments, problem.unknowns.times, strict=True):
        for place in places[places >= 0].tolist():
            found[place] = experiment.origin
    return tuple(found)


def estimate_many(
    problems: Sequence[Problem],
    *,
    tolerance: float = 1e-7,
    max_iterations: int = 200,
    client: Any = None,
    folder: str | Path | None = None,
    callback: Callable[[int, int], object] | None = None,
) -> Fits:
    """Fit many problems of one model, each with its own data, guess and mesh.

    Parameters
    ----------
    problems : sequence of Problem
        With the same modes, mode sequences, kinds of data and unknowns. Numbers of samples may differ; problems whose
        padded lengths agree share one compiled program.
    tolerance, max_iterations : as of `estimate`
    client, folder, callback : as of `monte_carlo`

    Returns
    -------
    Fits
        In the order of the problems. Fits whose integration error turns out too large are done again by `estimate`.

    Raises
    ------
    ValueError
        If the problems differ in more than their numbers, or the folder holds something else.
    TypeError
        If an argument is of the wrong type.

    See Also
    --------
    estimate, monte_carlo, multistart

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> fits = sf.estimate_many([heater_problem() for _ in range(3)])
    >>> fits.theta.shape, bool(fits.success.all())
    ((3, 2), True)
    """
    problems = list(as_sequence(problems, "problems", "a sequence of sf.Problem"))
    how = LongRun.check(tolerance, max_iterations, client, folder, callback)
    if not problems:
        raise ValueError("estimate_many needs one problem or more; got none.")
    first = problems[0]
    for k, problem in enumerate(problems):
        as_instance(problem, f"problems[{k}]", Problem, "an sf.Problem")
        require_estimable(problem)
        if problem.theta_names != first.theta_names or problem.is_sigma_known is not first.is_sigma_known:
            raise ValueError(
                f"problem {k} differs from the first one in more than its numbers: it has the unknowns "
                f"{join_names(problem.theta_names)}, the first one {join_names(first.theta_names)}. Fit it by itself."
            )
        units = [[run.time_unit for run in of.experiments] for of in (problem, first)]
        if units[0] != units[1]:
            raise ValueError(
                f"problem {k} has its times in {', '.join(units[0])}, the first one in {', '.join(units[1])}: their "
                "estimates would stand in one array. Give all logs the same time_unit, with their times in it."
            )
    starts = np.array([problem.initial_theta for problem in problems])
    study = StudyOfLogs(first, [], starts, how.limits, 0, problems)
    found = repeat(first, study, len(problems), "Logs", how)
    every = zip(*map(list_origins, problems), strict=True)
    return Fits(**found | {"date_origins": tuple(own[0] if len(set(own)) == 1 else None for own in every)})
