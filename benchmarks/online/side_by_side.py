"""Short drives, sample by sample: switchfit, a bank of filters that interact, and moving horizon estimation.

All get the same samples, the model as it is, the initial state, sigma, and one guess of mu. What a peer says is the
probability, or the share, of slip; a change of mode is declared where that crosses a level. Settings of "tuned" rows
are the best of those tried on other drives, see `choose`; those of moving horizon estimation, see `HORIZONS`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np

import switchfit as sf
from benchmarks.models import VEHICLE
from benchmarks.online.drives import BOUNDS, GUESS, MU, PERIOD, SENSORS, SIGMA, Drive, build_problem, simulate
from switchfit.online.estimator import THRESHOLD

LENGTH, CHANGES, EITHER = 15.0, (6.0, 10.0), 0.3
"""s, s, and s by which the changes of a drive may come before or after these."""

WINDOW = 3.0
"""s, of switchfit's row with one."""
INTENSITIES = (0.005, 0.02, 0.05)
"""Smaller ones change nothing: mixing the filters makes the covariances wider than they do."""
LIKELIEST = (0.98, 0.5)
"""Probability to stay for a sample interval, and level: 0.98 is a duration of 5 s, as in the drives."""
TUNING = range(100, 130)
"""Seeds of the drives on which `choose` compares settings."""
STAYS, LEVELS = (0.98, 0.995, 0.999, 0.9998), (0.5, 0.7, 0.9, 0.97)
"""Probabilities to stay and levels among which the banks' setting is chosen, one for all of INTENSITIES."""
THRESHOLDS = (THRESHOLD, 14.0, 16.0, 20.0)
"""Those among which switchfit's is chosen; the first is the default."""
HORIZONS = ((5, 0.5), (8, 0.6), (12, 0.6))
"""How many of the last shares are averaged, and level: the last two have the shortest delays of those with no wrong
path on 8 drives, seeds 100 to 107, one with headings and one without."""
SMOOTH = 3.0
"""Weight of the differences of neighbouring shares; larger ones are later to know that it slips."""

HEADER = ("", "wrong paths", "wrong at the end", "early", "slip known after", "stick known after", "mu", "times", "ms")
MEANING = (
    "*Wrong paths*: drives in which other modes were declared, one after the other, than stick, slip, stick; *at the "
    "end*, of what switchfit then says of the whole drive. *Early*: drives with slip declared before it began. Delays "
    "in s: median, largest; *mu*, *times*: root mean square of the errors at the end, of mu in s/m and of both changes "
    "in s (of so many drives); *ms*: median and 99th percentile of an update."
)


@dataclass(frozen=True, eq=False)
class Told:
    """What was said of one drive: modes (K,), 1 for slip; mu at the end; seconds (K,) of the updates.

    `changes` are the times of both changes as they are known at the end, None if they are not estimated or others were
    found; `wrong` whether the sequence at the end is, None for those who never revise it.
    """

    modes: np.ndarray
    mu: float
    seconds: np.ndarray
    changes: np.ndarray | None = None
    wrong: bool | None = None


def simulate_drives(seeds: Iterable[int]) -> list[Drive]:
    """Return a short drive for each seed."""
    found = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        found.append(simulate(np.array(CHANGES) + rng.uniform(-EITHER, EITHER, 2), LENGTH, rng))
    return found


def declare(shares: np.ndarray, level: float) -> np.ndarray:
    """Return modes (K,) that change where the share (K,) of the other one exceeds a level."""
    found, mode = np.zeros(len(shares), dtype=int), 0
    for k, share in enumerate(shares):
        if (share, 1 - share)[mode] > level:
            mode = 1 - mode
        found[k] = mode
    return found


def feed(update: Callable[[float, np.ndarray], Any], drive: Drive, sensor: str) -> tuple[list[Any], np.ndarray]:
    """Return what was said after each sample, and the seconds that it took."""
    said, seconds = [], []
    for t, y in drive.read(sensor):
        began = perf_counter()
        said.append(update(t, y))
        seconds.append(perf_counter() - began)
    return said, np.array(seconds)


def follow(sensor: str, window: float | None, drive: Drive, threshold: float = THRESHOLD) -> Told:
    """Return what switchfit says."""
    online = sf.OnlineEstimator(build_problem(sensor), window=window, threshold=threshold)
    said, seconds = feed(online.update, drive, sensor)
    now, modes = said[-1], np.array([each.mode == "slip" for each in said], dtype=int)
    # With a window, changes that have left it are no longer refined, and stand as they were.
    right = len(now.transition_times) == len(drive.taus)
    return Told(modes, float(now.parameters["mu"]), seconds, now.transition_times if right else None, not right)


def run_bank(
    sensor: str, q: float, stay: float, levels: Iterable[float], drives: list[Drive]
) -> dict[float, list[Told]]:
    """Return what filterpy's bank says, for each level."""
    from benchmarks.peers.filterpy_bank import Bank, build_steps

    seen = SENSORS[sensor]
    found: dict[float, list[Told]] = {level: [] for level in levels}
    model = replace(VEHICLE, p=(GUESS,))
    steps = build_steps(model, PERIOD)
    for drive in drives:
        bank = Bank(model, steps, PERIOD, seen, [SIGMA] * len(seen), q, stay)
        said, seconds = feed(bank.update, drive, sensor)
        shares = np.array([share for share, _ in said])
        for level, told in found.items():
            told.append(Told(declare(shares, level), said[-1][1], seconds))
    return found


def run_horizon(sensor: str, drives: list[Drive]) -> dict[str, list[Told]]:
    """Return what moving horizon estimation says, for each way to declare a change."""
    from benchmarks.peers.casadi_horizon import Horizon, Program

    seen = SENSORS[sensor]
    program = Program(replace(VEHICLE, p=(GUESS,)), PERIOD, seen, [SIGMA] * len(seen), BOUNDS, SMOOTH)
    names = [f"mean of {PERIOD * last:g} s beyond {level:g}" for last, level in HORIZONS]
    found: dict[str, list[Told]] = {name: [] for name in names}
    for drive in drives:
        said, seconds = feed(Horizon(program).update, drive, sensor)
        for name, (last, level) in zip(names, HORIZONS, strict=True):
            modes = declare(np.array([shares[-last:].mean() for shares, _ in said]), level)
            changes = find_changes(modes, drive.times, [shares for shares, _ in said])
            found[name].append(Told(modes, said[-1][1], seconds[len(said[0][0]) :], changes))
    return found


def find_changes(modes: np.ndarray, times: np.ndarray, shares: list[np.ndarray]) -> np.ndarray | None:
    """Return when both changes were, by the step function that is nearest to the shares half a horizon later."""
    declared = np.flatnonzero(np.diff(modes, prepend=0))
    if len(declared) != len(CHANGES):
        return None
    found = []
    for k in declared:
        at = min(k + len(shares[k]) // 2, len(shares) - 1)
        away = np.abs(shares[at] - modes[k])  # from the new mode
        costs = np.concatenate([[0.0], np.cumsum(1 - away)]) + np.concatenate([np.cumsum(away[::-1])[::-1], [0.0]])
        found.append(times[at] - PERIOD * (len(away) - np.argmin(costs)))
    return np.array(found)


def find_delay(says: np.ndarray, drive: Drive, k: int) -> float:
    """Return how long after change k it is said for the first time, at which samples `says` (K,); inf if never."""
    known = drive.times[(drive.times >= drive.taus[k]) & says]
    return float(known[0] - drive.taus[k]) if len(known) else np.inf


def judge(told: list[Told], drives: list[Drive]) -> tuple[int, int, np.ndarray]:
    """Return the number of wrong paths, of drives with slip declared too early, and the delays (drives, changes)."""
    wrong = early = 0
    delays = np.full((len(drives), len(CHANGES)), np.nan)
    for one, drive, own in zip(told, drives, delays, strict=True):
        path = one.modes[np.flatnonzero(np.diff(one.modes, prepend=-1))].tolist()
        wrong += path != [0, 1, 0]
        early += bool(one.modes[drive.times < drive.taus[0]].any())
        own[:] = [find_delay(one.modes == 1 - k, drive, k) for k in range(len(CHANGES))]
    return wrong, early, delays


def choose(tried: dict[Any, list[Told]], drives: list[Drive]) -> Any:
    """Return the setting with the fewest wrong paths, and of those the one with the shortest delays: the sum of both
    medians.
    """

    def rank(setting: Any) -> tuple[int, float]:
        wrong, _, delays = judge(tried[setting], drives)
        return wrong, float(np.median(delays, axis=0).sum())

    return min(tried, key=rank)


def tune_threshold(sensor: str, drives: list[Drive]) -> float:
    """Return switchfit's threshold for these drives."""
    return choose({level: [follow(sensor, None, drive, level) for drive in drives] for level in THRESHOLDS}, drives)


def tune_bank(sensor: str, drives: list[Drive]) -> tuple[float, float]:
    """Return the banks' probability to stay and level for these drives, at all intensities together."""
    tried: dict[tuple[float, float], list[Told]] = {(stay, level): [] for stay in STAYS for level in LEVELS}
    for q in INTENSITIES:
        for stay in STAYS:
            for level, told in run_bank(sensor, q, stay, LEVELS, drives).items():
                tried[stay, level] += told
    return choose(tried, drives * len(INTENSITIES))


def describe(name: str, told: list[Told], drives: list[Drive]) -> tuple[str, ...]:
    """Return a row of the table."""
    wrong, early, delays = judge(told, drives)
    changes = [one.changes - drive.taus for one, drive in zip(told, drives, strict=True) if one.changes is not None]
    seconds = 1e3 * np.concatenate([one.seconds for one in told])
    return (
        name,
        str(wrong),
        "" if told[0].wrong is None else str(sum(bool(one.wrong) for one in told)),
        str(early),
        *(f"{np.median(own):.2f}, {own.max():.2f}" for own in delays.T),
        f"{np.sqrt(np.mean([(one.mu - MU) ** 2 for one in told])):.2g}",
        f"{np.sqrt(np.mean(np.square(changes))):.2g} ({len(changes)})" if changes else "",
        "{:.2f}, {:.2f}".format(*np.percentile(seconds, [50, 99])),
    )


def compare(
    sensor: str, drives: list[Drive], others: list[Drive], report: Callable[[str], None]
) -> tuple[list[tuple[str, ...]], list[Told]]:
    """Return the rows of the table of a sensor, and what switchfit said without a window.

    The settings of the tuned rows are chosen on other drives.
    """
    rows, kept = [], []
    threshold = tune_threshold(sensor, others)
    report(f"{sensor}: tuned threshold {threshold:g}")
    for name, window, level in (
        ("switchfit", None, THRESHOLD),
        (f"switchfit, tuned (threshold {threshold:g})", None, threshold),
        (f"switchfit, window of {WINDOW:g} s", WINDOW, THRESHOLD),
    ):
        told = [follow(sensor, window, drive, level) for drive in drives]
        kept = kept or told
        rows.append(describe(name, told, drives))
        report(f"{sensor}: {name}")
    try:
        tuned = tune_bank(sensor, others)
        report(f"{sensor}: tuned bank {tuned}")
        for q in INTENSITIES:
            for name, (stay, level) in {"likeliest mode": LIKELIEST, "tuned": tuned}.items():
                told = run_bank(sensor, q, stay, [level], drives)[level]
                rows.append(describe(f"filterpy IMM, q = {q:g}, {name}", told, drives))
            report(f"{sensor}: filterpy, q = {q:g}")
    except ImportError as error:
        rows.append((f"filterpy IMM: not installed ({error.name})", *[""] * (len(HEADER) - 1)))
    try:
        for name, told in run_horizon(sensor, drives).items():
            rows.append(describe(f"CasADi MHE, {name}", told, drives))
        report(f"{sensor}: CasADi")
    except ImportError as error:
        rows.append((f"CasADi MHE: not installed ({error.name})", *[""] * (len(HEADER) - 1)))
    return rows, kept
