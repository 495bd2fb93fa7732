"""A first problem file with a model and data: what `switchfit init` writes.

The first model suits any log: each channel approaches a level, another one from an estimated time on. Levels, noise
and that time are guessed from the log.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from string import Template

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.cli.examples import find_examples
from switchfit.cli.files import refuse_existing
from switchfit.cli.toml_writer import write_value
from switchfit.io.logs.log import Log
from switchfit.io.logs.reader import read_log
from switchfit.problem.time_units import SECONDS_OF_UNIT
from switchfit.runtime.errors import InputError

LARGEST_COPY = 20_000_000
"""Bytes of a log up to which it is copied; a larger one is referred to where it is."""

MOST_MODELLED_CHANNELS = 3
"""Channels that the first model has; the others are named in a comment."""

FEWEST_SAMPLES = 8
TEMPLATES = Path(__file__).parent / "templates"


def write_first_problem(folder: Path, log: Path | None) -> list[Path]:
    """Write a problem file, its model and its data into a new folder; return what was written.

    Parameters
    ----------
    folder : Path
        It must not exist, or be empty.
    log : Path or None
        The data; None for an example.

    Raises
    ------
    InputError
        If the folder has something in it, or the log cannot be used.
    """
    refuse_existing(folder, "NAME")
    texts: dict[str, str] = {}
    if log is None:
        copied = [find_examples() / "_first" / name for name in ("problem.toml", "model.py", "log.csv")]
    else:
        read = read_log(log)
        channels, others = choose_channels(read)
        # A folder of a ROS bag, and a large log, are referred to where they are.
        copied = [log] if log.is_file() and log.stat().st_size <= LARGEST_COPY else []
        # Relative to the new folder, so that both may be moved together.
        named = log.name if copied else Path(os.path.relpath(log, folder)).as_posix()
        texts["problem.toml"] = write_problem(read, channels, others, named)
        texts["model.py"] = _fill_template(
            "model.py.template",
            source=log.name,
            count=len(channels),
            names=tuple(channels),
            units=tuple(read.units.get(name, "") for name in channels),
        )
    # All texts are complete before the first file is written: a log that cannot be used leaves no folder behind.
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    for path in copied:
        shutil.copyfile(path, folder / path.name)
    return [folder / name for name in (*texts, *(path.name for path in copied))]


def choose_channels(log: Log) -> tuple[list[str], list[str]]:
    """Return the channels of a first model, and the others that vary.

    Parameters
    ----------
    log : Log

    Raises
    ------
    InputError
        If no channel of the log changes, or it is too short.
    """
    varying = [name for name, values in log.values.items() if _is_varying(values)]
    is_track = log.has_positions and {"east", "north"} <= set(varying)
    if is_track:
        # A stable sort: all other channels keep the order of the file.
        varying.sort(key=lambda name: name not in ("east", "north"))
    # They belong to other channels, and are no states.
    usable = [name for name in varying if not name.startswith("sigma")]
    if not usable:
        raise InputError(
            f"{log.source} has no channel with {FEWEST_SAMPLES} samples or more that changes; its channels are "
            f"{', '.join(log.values) or 'none'}."
        )
    count = 2 if is_track else MOST_MODELLED_CHANNELS
    return usable[:count], usable[count:]


def _is_varying(values: FloatArray) -> bool:
    """Return whether a channel has enough samples, is not constant, and does not just count the rows."""
    known = values[np.isfinite(values)]
    # Of the differences, so that a counter, which rises by the same each time, is no channel. Relative to the range:
    # rounding of a straight line is no variation.
    return len(known) >= FEWEST_SAMPLES and bool(np.ptp(np.diff(known)) > 1e-9 * np.ptp(known))


def _fill_gaps(values: FloatArray) -> FloatArray:
    """Return values with missing samples interpolated."""
    places, known = np.arange(len(values)), np.isfinite(values)
    return np.interp(places, places[known], values[known])


def _guess_levels(values: FloatArray) -> tuple[int, FloatArray, FloatArray, FloatArray]:
    """Return the row of the transition, the levels before and after it, (q,), and how far values (K, q) are off them.

    A step from one mean to another at that row explains most of the values, scaled alike. The second level is that of
    the second half of the rows after it.
    """
    # With z the values less their mean, scaled, and S_k the sum of the first k of them: two means instead of one take
    # S_k^2 (1/k + 1/(n - k)) off the sum of squares. The largest of these over k is the best step, all in one pass.
    sums, count = np.cumsum((values - values.mean(0)) / values.std(0), axis=0), len(values)
    rows = np.arange(1, count)
    explained = (sums[:-1] ** 2).sum(1) * (1 / rows + 1 / (count - rows))
    # Not in the first or last twentieth, where a single outlier makes the best step.
    inside = slice(max(count // 20, 1), -max(count // 20, 1))
    k = int(rows[inside][explained[inside].argmax()])
    # The state approaches its new level exponentially: the mean of the second half is nearer to it.
    half = k + (count - k) // 2
    before, after = values[:k].mean(0), values[half:].mean(0)
    off = np.concatenate([values[:k] - before, values[half:] - after]).std(0)
    # A log without noise, as a simulation writes it, still needs a positive sigma.
    return k, before, after, np.where(off > 0, off, np.abs(after - before) * 1e-3 + 1e-12)


def write_problem(log: Log, channels: list[str], others: list[str], file: str) -> str:
    """Return a problem file with first guesses that are computed from a log.

    Parameters
    ----------
    log : Log
    channels, others : list of str
        As from `choose_channels`.
    file : str
        The log, relative to the problem file.
    """
    # Others would be unreadable in a report: a log in ms or ns is fitted in s.
    time_unit = log.time_unit if log.time_unit in ("s", "min", "h", "d") else "s"
    scale = SECONDS_OF_UNIT[log.time_unit] / SECONDS_OF_UNIT[time_unit] if log.time_unit else 1.0
    # The file may need repair = ["sort"], which is written into it; the guesses are made of sorted rows.
    picked = np.argsort(log.times, kind="stable")
    times = log.times[picked] * scale
    values = np.stack([_fill_gaps(log.values[name][picked]) for name in channels], axis=1)
    k, before, after, noise = _guess_levels(values)
    horizon = float(times[-1] - times[0])
    several = len(channels) > 1
    unit = "" if several else log.units.get(channels[0], "")
    sigmas = [f"sigma_{number}" for number in range(1, len(channels) + 1)] if several else []
    states = [f"{{ value = {_format(v)} }},  # {s}" for s, v in zip(channels, values[0], strict=True)]
    return _fill_template(
        "problem.toml.template",
        source=Path(file).name,
        before=_format(before),
        after=_format(after),
        level_unit=f", unit = {write_value(unit)}" if unit else "",
        time_constant=_format(np.full(len(channels), 0.05 * horizon)),
        shortest=_format(0.1 * horizon / max(len(log) - 1, 1)),
        longest=_format(10 * horizon),
        unit=write_value(time_unit),
        noise="".join(
            f'{s} = {{ value = {_format(v)}, scale = "log" }}\n' for s, v in zip(sigmas, noise, strict=False)
        ),
        tau=_format(0.5 * (times[k - 1] + times[k]), 6),
        states="\n    ".join(states),
        data="\n".join(_describe_data(log, channels, others, file, scale, sigmas)),
    )


def _describe_data(
    log: Log, channels: list[str], others: list[str], file: str, scale: float, sigmas: list[str]
) -> Iterator[str]:
    """Yield the lines of the table of data."""
    yield f"file = {write_value(file)}"
    if log.time_name and log.place in ("line", "row"):
        yield f"time = {write_value(log.time_name)}"
    if scale != 1:
        yield f"time_scale = {scale:.12g}   # the times of the log are in {log.time_unit}"
    yield f"columns = {write_value(channels)}   # <- each measures the state of its name"
    if others:
        yield f"# further channels: {', '.join(others)}"
    yield from (f"# {issue}".replace(log.source, Path(log.source).name) for issue in log.issues)
    # What the file needs to be read at all; the log itself was read without repair, and says why above.
    repairs = ["sort"] if np.any(np.diff(log.times) < 0) else []
    repairs += ["drop-duplicates"] if len(np.unique(log.times)) < len(log) else []
    if repairs:
        yield f"repair = {write_value(repairs)}   # what may be changed of that"
    sigma = f"sigma = {write_value(sigmas)}   # <- standard deviations of the noise; numbers, if they are known"
    yield sigma if sigmas else "# sigma = 0.1   # <- standard deviation of the noise, if it is known"


def _fill_template(name: str, **values: object) -> str:
    return Template((TEMPLATES / name).read_text(encoding="utf-8")).substitute(values)


def _format(values: ArrayLike, digits: int = 4) -> str:
    """Return a number with a few digits, as a float of TOML; a list of them for an array of several."""
    shown = [repr(float(f"{value:.{digits}g}")) for value in np.ravel(values).tolist()]
    return shown[0] if len(shown) == 1 else f"[{', '.join(shown)}]"
