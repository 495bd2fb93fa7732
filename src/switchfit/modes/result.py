"""The result of a search for the mode sequence."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.arrays import FloatArray
from switchfit.batch.fits_archive import describe_best, load_best
from switchfit.estimation.estimates import Estimate
from switchfit.modes.certifier import Certifier
from switchfit.modes.fitted import Fitted
from switchfit.modes.library_problem import build_library_problem
from switchfit.modes.schedule import Schedule
from switchfit.modes.status import ModeEnding, ModeStatus, ModeWarning
from switchfit.problem.experiment import name_runs
from switchfit.problem.problem import Problem
from switchfit.problem.validation.arrays import as_array, as_index
from switchfit.problem.validation.messages import join_names
from switchfit.problem.validation.objects import as_instance, as_path
from switchfit.runtime.json_documents import read_document, write_document
from switchfit.runtime.json_records import from_json, to_json
from switchfit.runtime.presentation import Displayed, Figure, draw_figure, format_line
from switchfit.strategy.library import Library

SEARCH_FORMAT = "switchfit modes"
SEARCH_VERSION = 5


@dataclass(frozen=True, eq=False)
class ModeFit:
    """One mode sequence that was fitted in a search.

    Attributes
    ----------
    sequences : tuple of tuple of str, one for each experiment
    transition_times : tuple of (N,) arrays, one for each experiment
    parameters : (M,)
        Free parameters and initial states, in the order of theta.
    acting : (M,) bool
        Those that act in the modes of the sequences; the others are held.
    cost : float
    criterion, bic, mbic, aicc : float
        By which the search has chosen, mBIC discounted where the residuals are not noise; and the information criteria
        as they stand, NaN if the cost is no likelihood.
    weight : float
        ``exp(-mbic / 2)`` over the alternatives, normalized; 0 for sequences that are no alternatives. Of the criterion
        instead of mBIC if that is "aicc" or one's own; of the discounted mBIC where the residuals are not noise.

    See Also
    --------
    ModeSearch

    Examples
    --------
    >>> search = sf.find_modes(heater_problem(), max_switches=2)
    >>> [fit.switches for fit in search.fitted]
    [0, 1, 2]
    """

    sequences: tuple[tuple[str, ...], ...]
    transition_times: tuple[NDArray[np.float64], ...]
    parameters: NDArray[np.float64]
    acting: NDArray[np.bool_]
    cost: float
    criterion: float
    weight: float
    bic: float = np.nan
    mbic: float = np.nan
    aicc: float = np.nan

    @property
    def switches(self) -> int:
        """Number of switches of all experiments."""
        return sum(len(sequence) - 1 for sequence in self.sequences)


@dataclass(frozen=True, eq=False)
class SavedSearch:
    """What of a search is saved, beside its best estimate; see `ModeSearch`."""

    modes: tuple[str, ...]
    durations: tuple[float, ...]
    max_switches: int
    criterion: str
    parameter_names: tuple[str, ...]
    run_names: tuple[str, ...]
    time_units: tuple[str, ...]
    starts: tuple[float, ...]
    ends: tuple[float, ...]
    sigma_known: bool | None
    ending: ModeEnding
    fits: int
    evaluations: int
    seconds: float
    fitted: tuple[ModeFit, ...] = ()
    chosen: tuple[ModeFit, ...] = ()
    warnings: tuple[ModeWarning, ...] = ()


@dataclass(frozen=True, eq=False)
class ModeSearch(SavedSearch, Displayed):
    """Result of `find_modes`. Print it for the report.

    Attributes
    ----------
    modes : tuple of str
        Of the library.
    durations : tuple of float
        Shortest time that each of these lasts.
    max_switches : int
    criterion : str
        By which the number of switches was chosen.
    parameter_names : tuple of str, M
        Of the parameters and initial states of each `ModeFit`.
    run_names, time_units : tuple of str, one for each experiment
    starts, ends : tuple of float, one for each experiment
        t0 and tf.
    sigma_known : bool or None
        None if the cost is no likelihood.
    ending : ModeEnding
        The status with what belongs to it, as data.
    fits, evaluations : int
        Fits, and evaluations of J with its derivatives.
    seconds : float
    fitted : tuple of ModeFit
        The best sequence that was met for each number of switches, ascending; those with fewer switches than the best
        were fitted from few starts.
    chosen : tuple of ModeFit
        Sequences whose mBIC (see `ModeFit.weight`) is within 10 of the lowest, the best first.
    warnings : tuple of ModeWarning
    best : Estimate or None
        The best sequence's, certified like any other; None if no sequence could be fitted.
    problem : Problem or None
        That was searched; None if the search was loaded without it.

    See Also
    --------
    find_modes : returns it.

    Examples
    --------
    >>> search = sf.find_modes(heater_problem(), max_switches=3)
    >>> search.mode_sequence, search.status.name
    (('on', 'off'), 'FOUND')
    >>> search.mode_probability([1.0, 5.0]).round(2)
    array([[1., 0.],
           [0., 1.]])
    """

    best: Estimate | None = None
    problem: Problem | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        if not self.chosen:
            return format_line(self, self.status.name)
        best = self.chosen[0]
        sequence = " | ".join(" -> ".join(modes) for modes in best.sequences)
        return format_line(self, self.status.name, sequence, f"J = {best.cost:.6g}")

    @property
    def status(self) -> ModeStatus:
        """How the search ended."""
        return self.ending.status

    @property
    def success(self) -> bool:
        """Whether the sequence may be relied on: `status` is FOUND or UNIDENTIFIED."""
        return self.status.successful

    @property
    def message(self) -> str:
        """The status as a sentence, with the remedy."""
        return str(self.ending)

    @property
    def mode_sequences(self) -> tuple[tuple[str, ...], ...]:
        """The best mode sequence of each experiment."""
        return self._require_best().sequences

    @property
    def mode_sequence(self) -> tuple[str, ...]:
        """The best mode sequence, of the only experiment."""
        found = self.mode_sequences
        if len(found) > 1:
            raise ValueError(
                f"there are {len(found)} experiments, each with a sequence of its own: see mode_sequences."
            )
        return found[0]

    @property
    def transition_times(self) -> tuple[FloatArray, ...]:
        """Transition times of the best, one (N,) array for each experiment."""
        return self._require_best().transition_times

    @property
    def parameters(self) -> dict[str, FloatArray]:
        """Parameters of the best by name, fixed ones included."""
        if self.best is not None:
            return dict(self.best.parameters)
        given = self._require_best().parameters
        return {name: np.asarray(value) for name, value in zip(self.parameter_names, given, strict=True)}

    def _require_best(self) -> ModeFit:
        if not self.chosen:
            raise ValueError(f"no mode sequence was found: {self.message}")
        return self.chosen[0]

    def _estimate(self, fit: ModeFit) -> Estimate:
        """Return the estimate of a sequence, computed at the first access."""
        # The best is certified already, and a file without its model has that one alone.
        if self.best is not None and self.chosen and fit.sequences == self.chosen[0].sequences:
            return self.best
        return self._certifier.estimate(self._restore(fit))

    def _restore(self, fit: ModeFit) -> Fitted:
        """Return a sequence as the search has fitted it."""
        given = zip(fit.sequences, fit.transition_times, self.starts, self.ends, strict=True)
        return Fitted(tuple(Schedule(*each) for each in given), fit.parameters, fit.acting, fit.cost)

    @cached_property
    def _certifier(self) -> Certifier:
        """What estimates any sequence of a library without restrictions, all of which share a program."""
        if self.problem is None:
            raise ValueError(
                "This search was loaded without its model, and its file has the estimate of the best sequence "
                "alone: load it with ModeSearch.load(path, problem=problem)."
            )
        # No restrictions are needed any more: sequences that were fitted are admitted by what the search was told.
        followers = {mode: tuple(other for other in self.modes if other != mode) for mode in self.modes}
        durations = dict(zip(self.modes, self.durations, strict=True))
        library = Library(self.modes, self.modes, self.modes, followers, durations, self.max_switches)
        return Certifier(build_library_problem(self.problem, library), self.problem, library)

    @cached_property
    def by_switches(self) -> dict[int, Estimate]:
        """The best estimate for each number of switches (of all experiments together), fitted at the first access.

        Not for a sequence with nothing to estimate.
        """
        return {fit.switches: self._estimate(fit) for fit in self.fitted if fit.switches or fit.acting.any()}

    @cached_property
    def alternatives(self) -> tuple[tuple[Estimate, float, float], ...]:
        """Estimate, criterion and weight of each of `chosen`, the best first; the weights sum to 1."""
        return tuple((self._estimate(fit), fit.criterion, fit.weight) for fit in self.chosen)

    def mode_probability(self, t: ArrayLike, *, experiment: int = 0) -> FloatArray:
        """Return the probability of each mode at times t, the weights of the alternatives summed: (L, K).

        Parameters
        ----------
        t : (L,) array_like
            Inside the horizon.
        experiment : int

        Returns
        -------
        array
            A column for each of `modes`.

        Raises
        ------
        ValueError
            For times outside the horizon, an experiment that is not there, or a search that has found nothing.

        Notes
        -----
        It is that of the sequences. Each has the transition times of its best fit: the uncertainty of these is in the
        estimates.

        See Also
        --------
        find_modes

        Examples
        --------
        >>> search = sf.find_modes(heater_problem(), max_switches=2)
        >>> search.modes, search.mode_probability([0.5]).round(2)
        (('on', 'off'), array([[1., 0.]]))
        """
        self._require_best()
        times = np.atleast_1d(as_array(t, "t"))
        e = as_index(experiment, "experiment", len(self.run_names))
        outside = (times < self.starts[e]) | (times > self.ends[e])
        if outside.any():
            raise ValueError(
                f"t must lie inside the horizon, [{self.starts[e]}, {self.ends[e]}]; got {times[outside][0]}."
            )
        found = np.zeros((len(times), len(self.modes)))
        rows = np.arange(len(times))
        for fit in self.chosen:
            sequence = [self.modes.index(mode) for mode in fit.sequences[e]]
            # At a transition time the mode after it counts.
            found[rows, np.take(sequence, np.searchsorted(fit.transition_times[e], times, "right"))] += fit.weight
        return found

    def plot(self) -> Figure:
        """Draw the criteria by number of switches, the best fit with its modes shaded, and the mode probabilities.

        See Also
        --------
        find_modes

        Examples
        --------
        >>> search = sf.find_modes(heater_problem(), max_switches=2)
        >>> len(search.plot().axes)
        3
        """
        return draw_figure(self)

    def save(self, path: str | Path) -> None:
        """Write everything but the model to a JSON file, atomically; `load` reads it.

        Parameters
        ----------
        path : path

        See Also
        --------
        ModeSearch.load

        Examples
        --------
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> search = sf.find_modes(heater_problem(), max_switches=2)
        >>> with TemporaryDirectory() as folder:
        ...     search.save(Path(folder) / "modes.json")
        ...     sf.ModeSearch.load(Path(folder) / "modes.json").mode_sequence
        ('on', 'off')
        """
        file = as_path(path, "path")
        content: dict[str, Any] = {"format": SEARCH_FORMAT, "version": SEARCH_VERSION, "message": self.message}
        content["search"] = to_json(self, SavedSearch)
        # By its name: the sentence that is an enum's value may be worded anew, and files must stay readable.
        content["search"]["ending"]["status"] = self.status.name
        content["best"] = None if self.best is None else describe_best(self.best)
        write_document(content, file)

    @classmethod
    def load(cls, path: str | Path, *, problem: Problem | None = None) -> ModeSearch:
        """Read what `save` wrote.

        Parameters
        ----------
        path : path
        problem : Problem, optional
            The problem that was searched, for estimates of other sequences, profiles and predictions: a file does not
            contain the model.

        Raises
        ------
        ValueError
            If the file is not one of switchfit's, is damaged, or the problem has other modes, runs or parameters.

        See Also
        --------
        ModeSearch.save

        Examples
        --------
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> search = sf.find_modes(heater_problem(), max_switches=2)
        >>> with TemporaryDirectory() as folder:
        ...     search.save(Path(folder) / "modes.json")
        ...     again = sf.ModeSearch.load(Path(folder) / "modes.json", problem=heater_problem())
        >>> again.by_switches[0].cost > again.best.cost
        True
        """
        file = as_path(path, "path")
        if problem is not None:
            as_instance(problem, "problem", Problem, "an sf.Problem")
        content = read_document(file, "a saved search", SEARCH_FORMAT, SEARCH_VERSION)
        try:
            record = from_json(SavedSearch, content.get("search"), "search")
            best = load_best(content.get("best"))
        except (ValueError, OverflowError, RecursionError, MemoryError, AttributeError) as error:
            raise ValueError(f"{file} is damaged: {error}.") from error
        own = {f.name: getattr(record, f.name) for f in fields(SavedSearch)}
        if problem is not None:
            _check_problem(record, problem, file)
            if best is not None:
                found = cls(**own, problem=problem)
                chosen = found._restore(found._require_best())
                # With its problem the estimate has profiles and predictions again.
                best = replace(best, problem=found._certifier.build_problem(chosen))
        return cls(**own, best=best, problem=problem)


def _check_problem(record: SavedSearch, problem: Problem, path: Path) -> None:
    """Raise ValueError unless a search that was loaded from a file may be that of a problem."""
    # Names and horizons alone: a file has no digest of the model and its data.
    runs, modes, ends = problem.experiments, problem.system.modes, list(zip(record.starts, record.ends, strict=True))
    same_runs = name_runs(runs) == record.run_names and [(run.t0, run.end) for run in runs] == ends
    if not (same_runs and set(record.modes) <= set(modes)):
        raise ValueError(
            f"{path} holds the runs {join_names(record.run_names)} with the modes {join_names(record.modes)}, the "
            f"problem has {join_names(name_runs(runs))} with {join_names(modes)}, or their horizons differ: it is "
            "another problem's."
        )
