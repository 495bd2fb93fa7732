"""The folder of a search: what was found and what was done, so that a search that was stopped goes on."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from switchfit.modes.fitter import Fitted, Fitter
from switchfit.modes.pool import Pool
from switchfit.modes.schedule import Schedule
from switchfit.optimize import Status
from switchfit.runtime.files import is_regular, set_aside, write_atomically
from switchfit.runtime.json_records import from_json, to_json

FORMAT, VERSION = "switchfit mode search", 2
FILE = "search.json"


@dataclass(frozen=True)
class SavedFit:
    """One fit of a pool."""

    sequences: tuple[tuple[str, ...], ...]
    transition_times: tuple[NDArray[np.float64], ...]
    parameters: NDArray[np.float64]
    cost: float
    status: Status


class SearchFolder:
    """A folder with the state of a search.

    Parameters
    ----------
    path : Path
        Made if there is none.
    fingerprint : str
        Of the problem and the settings: a state with another one is set aside.

    Attributes
    ----------
    done : list of str
        Labels of the parts of the search that have been done.
    """

    def __init__(self, path: Path, fingerprint: str) -> None:
        path.mkdir(parents=True, exist_ok=True)
        self.file, self.fingerprint = path / FILE, fingerprint
        self.done: list[str] = []
        self._fits: list[SavedFit] = []
        if is_regular(self.file):
            self._read()

    def _read(self) -> None:
        again = "The search begins anew."
        try:
            content = json.loads(self.file.read_bytes().decode())
            if content.get("format") != FORMAT or content.get("version") != VERSION:
                raise ValueError("it is not the state of a search in this version")
            done = [str(label) for label in content["done"]]
            fits = [from_json(SavedFit, fit, "fits") for fit in content["fits"]]
        except (ValueError, KeyError, AttributeError, TypeError, RecursionError) as error:
            return set_aside(self.file, str(error), again)
        if content.get("fingerprint") != self.fingerprint:
            return set_aside(self.file, "it belongs to another problem, or to other settings", again)
        self.done, self._fits = done, fits

    def load_fits(self, fitter: Fitter) -> Iterator[Fitted]:
        """Yield the fits that were found before."""
        runs = fitter.problem.experiments
        for fit in self._fits:
            given = zip(fit.sequences, fit.transition_times, runs, strict=True)
            schedules = tuple(Schedule(sequence, times, run.t0, run.end) for sequence, times, run in given)
            acting, guarded = fitter.find_acting(fit.sequences), fitter.count_guarded(fit.sequences)
            yield Fitted(schedules, fit.parameters, acting, fit.cost, fit.status, guarded)

    def save(self, label: str, pool: Pool) -> None:
        """Note that a part of the search has been done, with all that was found.

        Parameters
        ----------
        label : str
        pool : Pool
        """
        self.done.append(label)
        self._fits = [
            SavedFit(fitted.sequences, tuple(s.times for s in fitted.schedules), fitted.parameters, fitted.cost,
                     fitted.status)
            for fitted in pool
        ]  # fmt: skip
        content = {
            "format": FORMAT,
            "version": VERSION,
            "fingerprint": self.fingerprint,
            "done": self.done,
            "fits": [to_json(fit, SavedFit) for fit in self._fits],
        }
        write_atomically(json.dumps(content, allow_nan=False) + "\n", self.file, sync=False)
