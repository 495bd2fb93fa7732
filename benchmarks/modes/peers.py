"""Other libraries on the three linear modes of `benchmarks.modes.truths.three_modes`.

- ``filterpy``: a bank of Kalman filters, one a mode, that interact (IMM); the mode of an interval is the likeliest one.
  It is told the rate a, or gets the guess.
- ``ruptures``: optimal partitioning (`Dynp`) with the cost ``min_k sum |dy/dt - f_k(y)|^2``, derivatives from smoothed
  differences. It is told the rate and the number of changes, and sees all states.
- Relaxed control: weights of the modes in each sample interval and the rate by IPOPT (CasADi), rounded to one mode by
  sum-up rounding.

Each ends as a sequence with times; a fit of switchfit from there follows. `switchfit.find_modes` ends with a fit of its
own, which is the one that counts.
"""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

import switchfit as sf
from benchmarks.modes.study import AS_GOOD, compute_criterion
from benchmarks.modes.truths import LENGTH, MATRICES, NOISE, OFFSETS, START, STEP, Truth, three_modes

GUESS = 1.2
NAMES = "ABC"
SHORT = 8
"""Samples of the shortest segment that `ruptures` may choose."""
LONGEST = 12
"""Segments above which a sequence is not fitted: it is wrong in any case."""


class Found(NamedTuple):
    """Modes and transition times, and the fit that a method ends with; None if a fit from there has to follow."""

    sequence: tuple[str, ...]
    times: np.ndarray
    fit: sf.Estimate | None = None


def join_intervals(modes: Iterable[int]) -> Found:
    """Return the sequence and times of the modes of all sample intervals."""
    modes = list(modes)
    changes = [k for k in range(1, len(modes)) if modes[k] != modes[k - 1]]
    sequence = (NAMES[modes[0]], *(NAMES[modes[k]] for k in changes))
    return Found(sequence, STEP * np.array(changes, dtype=float))


def filter_modes(truth: Truth, rate: float) -> Found:
    """Return the modes that are likeliest in a bank of interacting Kalman filters."""
    from filterpy.kalman import IMMEstimator, KalmanFilter

    values = truth.problem.experiments[0].data[0].values
    filters = []
    for A, b in zip(MATRICES, OFFSETS, strict=True):
        block = np.zeros((3, 3))
        block[:2, :2], block[:2, 2] = rate * A, b
        step = scipy.linalg.expm(block * STEP)
        one = KalmanFilter(2, 2, 1)
        one.F, one.B, one.H = step[:2, :2], step[:2, 2:], np.eye(2)
        one.R, one.Q = NOISE**2 * np.eye(2), 1e-6 * np.eye(2)
        one.x, one.P = np.array(START)[:, None], 1e-4 * np.eye(2)
        filters.append(one)
    stay = 0.97
    change = np.full((3, 3), (1 - stay) / 2)
    np.fill_diagonal(change, stay)
    bank, modes = IMMEstimator(filters, np.ones(3) / 3, change), []
    for value in values[1:]:
        bank.predict(np.ones((1, 1)))
        bank.update(value[:, None])
        modes.append(int(np.argmax(bank.mu)))
    return join_intervals(modes)


def partition(truth: Truth) -> Found:
    """Return the optimal partition into the true number of segments, each in the mode that fits its derivatives."""
    import ruptures

    values = truth.problem.experiments[0].data[0].values
    kernel = np.ones(5) / 5

    def smooth(columns: np.ndarray) -> np.ndarray:
        return np.stack([np.convolve(column, kernel, "same") for column in columns.T], axis=1)

    y, dy = smooth(values), smooth(np.gradient(values, STEP, axis=0))
    squares = np.stack([np.sum((dy - (y @ A.T + b)) ** 2, axis=1) for A, b in zip(MATRICES, OFFSETS, strict=True)], 1)
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(squares, axis=0)])

    class Cost(ruptures.base.BaseCost):
        model = "modes"
        min_size = SHORT

        def fit(self, signal: np.ndarray) -> Any:
            self.signal = signal
            return self

        def error(self, start: int, end: int) -> float:
            return float(np.min(sums[end] - sums[start]))

    search = ruptures.Dynp(custom_cost=Cost(), min_size=SHORT, jump=1).fit(squares)
    ends = [0, *search.predict(n_bkps=len(truth.times))]
    modes = np.zeros(len(values) - 1, dtype=int)
    for start, end in itertools.pairwise(ends):
        modes[start:end] = int(np.argmin(sums[end] - sums[start]))
    return join_intervals(modes)


def round_relaxed(truth: Truth) -> Found:
    """Return the relaxed weights of the modes, rounded by sum-up rounding."""
    import casadi as ca

    values = truth.problem.experiments[0].data[0].values
    count = round(LENGTH / STEP)
    state, weight, rate = ca.MX.sym("x", 2), ca.MX.sym("w", 3), ca.MX.sym("a")
    modes = zip(MATRICES, OFFSETS, strict=True)
    slope = sum(weight[k] * (rate * (ca.DM(A) @ state) + ca.DM(b)) for k, (A, b) in enumerate(modes))
    f = ca.Function("f", [state, weight, rate], [slope])
    k1 = f(state, weight, rate)
    k2 = f(state + STEP / 2 * k1, weight, rate)
    k3 = f(state + STEP / 2 * k2, weight, rate)
    k4 = f(state + STEP * k3, weight, rate)
    step = ca.Function("step", [state, weight, rate], [state + STEP / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
    weights, states, a = ca.MX.sym("W", 3, count), ca.MX.sym("X", 2, count + 1), ca.MX.sym("a")
    after = step.map(count)(states[:, :-1], weights, ca.repmat(a, 1, count))
    equal = [states[:, 0] - ca.DM(START), ca.vec(states[:, 1:] - after), ca.vec(ca.sum1(weights) - 1)]
    unknowns = ca.vertcat(a, ca.vec(weights), ca.vec(states))
    cost = 0.5 * ca.sumsqr((states - ca.DM(values.T)) / NOISE)
    options = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes", "ipopt.max_iter": 300}
    solver = ca.nlpsol("s", "ipopt", {"x": unknowns, "f": cost, "g": ca.vertcat(*equal)}, options)
    free = np.full(2 * (count + 1), np.inf)
    found = solver(
        x0=np.concatenate([[GUESS], np.full(3 * count, 1 / 3), values.ravel()]),
        lbx=np.concatenate([[0.2], np.zeros(3 * count), -free]),
        ubx=np.concatenate([[5.0], np.ones(3 * count), free]),
        lbg=0,
        ubg=0,
    )
    relaxed = np.asarray(found["x"]).ravel()[1 : 1 + 3 * count].reshape(count, 3)
    gap, chosen = np.zeros(3), []
    for row in relaxed:
        gap += row * STEP
        k = int(np.argmax(gap))
        gap[k] -= STEP
        chosen.append(k)
    return join_intervals(chosen)


def search_ourselves(truth: Truth) -> Found:
    """Return what `switchfit.find_modes` finds."""
    found = sf.find_modes(truth.problem, criterion="mbic", **truth.settings)
    return Found(found.mode_sequence, np.ravel(found.transition_times), found.best)


METHODS: dict[str, tuple[Callable[[Truth], Found], str, int]] = {
    "switchfit.find_modes": (search_ourselves, "modes", 100),
    "filterpy IMM": (lambda truth: filter_modes(truth, 1.0), "modes, rate", 100),
    "filterpy IMM, rate 20 % off": (lambda truth: filter_modes(truth, GUESS), "modes", 100),
    "ruptures Dynp": (partition, "modes, rate, number of changes, all states seen", 100),
    "relaxed control, IPOPT, sum-up rounding": (round_relaxed, "modes", 30),
}
"""What searches, what it is told, and how many truths it gets at most."""

HEADER = (
    "on the three linear modes",
    "is told",
    "truths",
    "true sequence",
    "after a fit",
    "criterion as good as from the truth",
    "processor time, median (s)",
)


def run(seeds: Iterable[int]) -> list[tuple[Any, ...]]:
    """Search the same truths with each method; return the rows of the table."""
    truths = [three_modes(seed) for seed in seeds]
    references = [truth.fit_from_truth() for truth in truths]
    rows = []
    for name, (method, told, most) in METHODS.items():
        method(truths[0])
        same, fitted, as_good, seconds = 0, 0, 0, []
        for truth, reference in zip(truths[:most], references, strict=False):
            began = time.process_time()
            sequence, times, fit = method(truth)
            seconds.append(time.process_time() - began)
            same += sequence == truth.sequence
            if len(sequence) > LONGEST:
                continue
            if fit is None:
                fit = sf.estimate(truth.build_problem(sequence, times), strategy="local")
            fitted += sequence == truth.sequence and fit.success
            limit = compute_criterion(truth, len(truth.times), reference.cost, "mbic") + AS_GOOD
            as_good += compute_criterion(truth, len(times), fit.cost, "mbic") <= limit
        count = len(seconds)
        median = f"{statistics.median(seconds):.3f}"
        rows.append((name, told, count, f"{same} of {count}", fitted, as_good, median))
        print(rows[-1], flush=True)
    return rows
