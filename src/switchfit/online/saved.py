"""The state of an online estimator in a file, and the journal of the samples since then.

The problem of the samples that an online estimator keeps, for `sf.estimate`.
"""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from switchfit.online.state import Now
from switchfit.online.tracker import Left, Start, Tracker
from switchfit.problem.data import FloatArray, Measurements
from switchfit.problem.parameter import Parameter
from switchfit.problem.problem import Problem
from switchfit.strategy.library import Sequences

ENTRIES, STATES = "state at the start of the window", "initial state"
"""Names of the parameters that stand for what is before a window."""

NO_EFFECT = 1e-12
"""Part of the largest second derivative below which one counts as none."""


def build_kept_problem(
    problem: Problem, now: Now, data: list[Measurements], given: dict[str, Any], arrival: Start | None
) -> Problem:
    """Return the problem of what has been measured since the start of the window, which begins at what was found.

    Parameters
    ----------
    problem : Problem
    now : Now
    data : list of Measurements
    given : dict of str to value
        What else the run has since then: its inputs, its modes and their times, t0 and tf.
    arrival : Start or None, if nothing has left the window
        In U parameters and A entries for the state, the parameters being where it has moved.
    """
    run, states, offset = problem.experiments[0], problem.unknowns.initial_states[0], problem.unknowns.is_time.sum()
    own = problem.system.initial_state if run.initial_state is None else run.initial_state
    parameters = {name: replace(each, value=now.parameters[name]) for name, each in problem.parameters.items()}
    initial: Any = own
    if arrival is not None:
        initial, sensor = _describe_arrival(problem, arrival, given["t0"])
        data = [sensor, *data]
        known = {ENTRIES: len(arrival.gradient) - len(arrival.moved), STATES: int((states >= 0).sum())}
        parameters = {name: replace(parameter, prior=None) for name, parameter in parameters.items()}
        parameters |= {name: Parameter(np.zeros(size)) for name, size in known.items() if size}
    elif (states >= 0).any():
        values = [float(now.best.theta[place - offset]) if place >= 0 else None for place in states.tolist()]
        initial = [
            entry if value is None else replace(entry, value=value) for entry, value in zip(own, values, strict=True)
        ]
    times = np.clip(given["transition_times"], given["t0"], given["tf"]).tolist()
    sequence, times = _drop_empty_modes(given["mode_sequence"], times, given["t0"], given["tf"])
    begins = given | {"mode_sequence": sequence, "transition_times": times, "initial_state": initial}
    return replace(problem, experiments=(replace(run, data=tuple(data), **begins),), parameters=parameters)


def _drop_empty_modes(
    sequence: tuple[str, ...], times: list[float], t0: float, tf: float
) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Return a sequence and its times without modes of no length, which a wrong model or outliers make."""
    names: list[str] = []
    begins: list[float] = []
    for name, begin, end in zip(sequence, [t0, *times], [*times, tf], strict=True):
        if end > begin and names[-1:] != [name]:
            names.append(name)
            begins.append(begin)
    return tuple(names), tuple(begins[1:])


def _describe_arrival(problem: Problem, arrival: Start, t0: float) -> tuple[Any, Measurements]:
    """Return the initial state as a function of the parameters, and the cost of the samples before as a measurement.

    With ``H = R'R`` and ``g = R's`` the cost is ``|R d + s|^2 / 2`` but for a constant: R d is measured to be -s.
    """
    unknowns, run = problem.unknowns, problem.experiments[0]
    values, vectors = np.linalg.eigh(arrival.matrix)
    there = values > NO_EFFECT * values[-1]
    R = (vectors[:, there] * np.sqrt(values[there])).T
    s = (vectors[:, there] / np.sqrt(values[there])).T @ arrival.gradient
    own = {problem_name: name for name, problem_name in run.parameter_map.items()}
    names = [own.get(name, name) for name in unknowns.parameters]
    has_entries = len(arrival.gradient) > len(arrival.moved)
    if (unknowns.initial_states[0] >= 0).any():
        names.append(STATES)

    def move(p: Any) -> Any:
        parameters = [jnp.ravel(jnp.asarray(p[name])) for name in names]
        entries = [p[ENTRIES]] if has_entries else []
        return jnp.concatenate([*entries, jnp.concatenate([*parameters, jnp.zeros(0)]) - arrival.moved])

    def begin(p: Any) -> Any:
        return arrival.state + arrival.tangent @ move(p)

    sensor = Measurements([t0], [-s], observe=lambda t, x, p: R @ move(p), sigma=1.0)
    return begin, sensor


FORMAT = "switchfit online 1"


def pack(tracker: Tracker, others: dict[str, Any]) -> bytes:
    """Return the arrays of a tracker and its feed, and other numbers, as a file."""
    feed = tracker.feed
    arrays: dict[str, Any] = {f"feed {name}": array for name, array in feed.copy_arrays().items()}
    for place, there in enumerate(tracker.kept):
        if there is not None:
            tracker.catch_up(place, there[1])
            arrays |= {f"kept {place} {name}": array for name, array in there[0]._asdict().items()}
    arrays |= {"records": tracker.records, "declared": tracker.declared}
    if tracker.start is not None:
        arrays |= {f"start {name}": np.asarray(array) for name, array in tracker.start._asdict().items()}
    numbers = others | {"format": FORMAT, "first": tracker.first, "dropped": tracker.dropped, "left": tracker.left}
    buffer = io.BytesIO()
    np.savez(buffer, numbers=np.frombuffer(json.dumps(numbers).encode(), dtype=np.uint8), **arrays)
    return buffer.getvalue()


def read(path: Path) -> tuple[dict[str, Any], dict[str, FloatArray]]:
    """Return the numbers and the arrays of a file; ValueError for any other."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        numbers = json.loads(arrays.pop("numbers").tobytes())
    except (ValueError, KeyError, EOFError) as error:
        raise ValueError(f"{path} is not a saved online estimator ({error}).") from error
    if numbers.get("format") != FORMAT:
        raise ValueError(f"{path} is of another version: it has {numbers.get('format')!r}, not {FORMAT!r}.")
    return numbers, arrays


def unpack(tracker: Tracker, numbers: dict[str, Any], arrays: dict[str, FloatArray], path: Path) -> None:
    """Give a tracker what was saved; ValueError if that is of another problem or other settings."""
    if arrays["records"].shape != tracker.records.shape:
        raise ValueError(f"{path} was saved for another problem, or with other settings: give the same ones.")

    def part(name: str) -> dict[str, Any]:
        begin = f"{name} "
        return {key.removeprefix(begin): array for key, array in arrays.items() if key.startswith(begin)}

    tracker.feed.set_arrays(part("feed"))
    tracker.records[:] = arrays["records"]
    tracker.declared = arrays["declared"].astype(np.int64)
    for place in range(len(tracker.kept)):
        found = part(f"kept {place}")
        tracker.kept[place] = tracker.view(place, Sequences(**found)) if found else None
    if start := part("start"):
        tracker.start = Start(**start)._replace(cost=float(start["cost"]))
    tracker.first, tracker.dropped = numbers["first"], numbers["dropped"]
    tracker.left = [Left(*each) for each in numbers["left"]]


def open_journal(path: Path) -> None:
    """Make a journal, a file with a line for each update, or leave out the last line of one that was cut off."""
    written = path.read_bytes() if path.exists() else b""
    with path.open("ab") as file:
        file.truncate(written.rfind(b"\n") + 1)


def append_update(path: Path, t: float, y: dict[int, FloatArray], u: Any) -> None:
    """Write an update to a journal, with the values of each sensor; it leaves the process before the update begins."""
    line = json.dumps({"t": t, "y": y, "u": u}, default=lambda value: np.asarray(value, dtype=np.float64).tolist())
    with path.open("ab", buffering=0) as file:
        file.write(line.encode() + b"\n")


def read_journal(path: Path) -> list[tuple[float, Any, Any]]:
    """Return the updates of a journal; the last one may have been cut off, and is left out then."""
    found = []
    for line in path.read_bytes().split(b"\n")[:-1]:
        try:
            each = json.loads(line)
            found.append((each["t"], {int(k): values for k, values in each["y"].items()}, each["u"]))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path} is not the journal of an online estimator ({error}).") from error
    return found
