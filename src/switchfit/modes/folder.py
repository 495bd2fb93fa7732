"""The folder of a search: what was found and what was done, so that a search that was stopped goes on."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.modes.fitter import Fitted, Fitter
from switchfit.modes.pool import Pool
from switchfit.modes.schedule import Schedule
from switchfit.optimize import Status
from switchfit.runtime.files import is_regular, set_aside, write_atomically
from switchfit.runtime.json_records import from_json, to_json

FORMAT, VERSION = "switchfit mode search", 1
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
    """

    def __init__(self, path: Path, fingerprint: str) -> None:
        path.mkdir(parents=True, exist_ok=True)
        self.file, self.fingerprint = path / FILE, fingerprint
        self._done: dict[str, list[str]] = {}
        self._fits: dict[str, list[SavedFit]] = {}
        if is_regular(self.file):
            self._read()

    def _read(self) -> None:
        again = "The search begins anew."
        try:
            content = json.loads(self.file.read_bytes().decode())
            if content.get("format") != FORMAT or content.get("version") != VERSION:
                raise ValueError("it is not the state of a search in this version")
            done = {str(name): [str(label) for label in labels] for name, labels in content["done"].items()}
            fits = {
                str(name): [from_json(SavedFit, fit, "fits") for fit in found]
                for name, found in content["fits"].items()
            }
        except (ValueError, KeyError, AttributeError, TypeError, RecursionError) as error:
            return set_aside(self.file, str(error), again)
        if content.get("fingerprint") != self.fingerprint:
            return set_aside(self.file, "it belongs to another problem, or to other settings", again)
        self._done, self._fits = done, fits

    def is_done(self, name: str, label: str) -> bool:
        """Return whether a part of the search has been done."""
        return label in self._done.get(name, ())

    def load_fits(self, name: str, fitter: Fitter) -> Iterator[Fitted]:
        """Yield the fits of a part of the search that were found before."""
        runs = fitter.problem.experiments
        for fit in self._fits.get(name, ()):
            given = zip(fit.sequences, fit.transition_times, runs, strict=True)
            schedules = tuple(Schedule(sequence, times, run.t0, run.end) for sequence, times, run in given)
            acting, guarded = fitter.find_acting(fit.sequences), fitter.count_guarded(fit.sequences)
            yield Fitted(schedules, fit.parameters, acting, fit.cost, fit.status, guarded)

    def save(self, name: str, label: str, pool: Pool) -> None:
        """Note that a part has been done, with all that was found.

        Parameters
        ----------
        name, label : str
        pool : Pool
        """
        self._done.setdefault(name, []).append(label)
        self._fits[name] = [
            SavedFit(fitted.sequences, tuple(s.times for s in fitted.schedules), fitted.parameters, fitted.cost,
                     fitted.status)
            for fitted in pool
        ]  # fmt: skip
        fits: dict[str, Any] = {part: [to_json(fit, SavedFit) for fit in found] for part, found in self._fits.items()}
        content = {
            "format": FORMAT,
            "version": VERSION,
            "fingerprint": self.fingerprint,
            "done": self._done,
            "fits": fits,
        }
        write_atomically(json.dumps(content, allow_nan=False) + "\n", self.file, sync=False)
