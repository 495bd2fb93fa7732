"""The course of a trajectory through the branches of modes with corners, while an adaptive solver runs.

After each step the ends of the branch are looked at. Where one is passed, the crossing is found on the cubic through
both ends of the step, and the solver goes on from there in the next branch. At a corner the trajectory goes on to the
side +1 if dg/dt > 0 along the field of that side, to -1 if dg/dt < 0 along the field of the other; if neither, it
slides.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from switchfit.arrays import BoolArray, FloatArray
from switchfit.discretization.arguments import Arguments
from switchfit.discretization.model import read_parameters
from switchfit.engine.corners.branch_functions import trace_for_numpy
from switchfit.engine.corners.branches import Branches, BranchPath
from switchfit.problem.corners.branches import Corners, Sides, find_corners
from switchfit.problem.functions import Function
from switchfit.problem.structure import Structure
from switchfit.runtime.errors import NotIntegrableError

MOST_SLIDING, MOST_STEEP = 6, 2
"""Largest number of corners along which a trajectory slides at a time, and of steep ones among them. Each adds a field
to the branch: programs of six bodies that rest compile in 40 s, and as many steep corners would take minutes."""

AT_CORNER = 1e-8
"""Part of the largest |g| so far below which a trajectory is at a corner, where rates decide and not the sign of g:
above what the location of a crossing and the errors of a solver leave of g = 0 at a state that is at rest."""

PASSED = 1e-7
"""The same for the end of a branch: it is passed where its function is below minus this part. More than `AT_CORNER`, so
that a trajectory that begins at a corner, or has just left one, does not pass it by rounding."""

PASSED_STEEP = 1e-10
"""The same for a steep corner. A tank that empties by sqrt(x) comes to x = 0 without a slope, and hardly falls below
it."""

STILL = 1e-6
"""Part of the larger dg/dt of both sides below which the other is zero: forces in balance leave their rounding."""

STUCK_AT_CORNER = 1e-6
"""Part of the largest |g| so far below which a solver that is stuck is at a corner: beside a root, whose slope is
infinite, its steps have become as short as rounding before it is any nearer."""

STEEP_MARGIN = 1e-8
"""Part of the largest |g| so far that is the margin of a steep corner: nearer to it the field is the one on the margin,
with slopes that are finite."""

NEAR_STEEP = 1e-4
"""Part of its margin at which the rates at a steep corner are taken, 1e-12 of the largest |g|: well above rounding, if
g is a difference."""

STILL_STEEP = 1e-5
"""Part of the largest rate of all corners below which a rate at a steep corner is zero: the root of 1e-12 is 1e-6."""

PARTS_OF_STEP = 16
"""Parts in which a step is divided, three times, to find where it leaves a branch: of functions that cross zero twice
in a step, the first passage, down to 1 / 4096 of the step."""


class BranchError(Exception):
    """A branch takes many steps in Python: the path has to be found anew, with it in machine code."""


class SteepError(Exception):
    """A branch ends where its field is undefined: the path has to be found anew, with a margin there."""


class TooManyCrossingsError(NotIntegrableError):
    """A trajectory passes more corners than a path may have."""


class Crossing(NamedTuple):
    """Where a trajectory leaves a branch: time (), state (n,), and which end of the branch it is."""

    time: float
    state: FloatArray
    end: int


class Course:
    """Follows a trajectory from branch to branch, and records its path.

    Parameters
    ----------
    branches : Branches
    structure : Structure
    arguments : Arguments
    p : (M,)
    smallest : float
        Size of a state below which its error is absolute.
    """

    def __init__(
        self, branches: Branches, structure: Structure, arguments: Arguments, p: FloatArray, smallest: float = 0.0
    ) -> None:
        self.branches, self._structure = branches, structure
        self._named = read_parameters(structure, arguments, p)
        self._nodes, self._signals = np.asarray(arguments.nodes), np.asarray(arguments.signals)
        self._sides: list[list[Sides]] = []
        self._ends: list[list[int]] = []
        self._times: list[float] = []
        self._scales: list[float] = []
        self._mode, self._scale = 0, np.zeros(0)
        self._largest: FloatArray | float = smallest
        self._last: FloatArray | None = None
        self._beyond = np.zeros(0)

    @property
    def path(self) -> BranchPath:
        """The path so far."""
        times, scales = np.array(self._times), np.array(self._scales)
        return BranchPath(tuple(map(tuple, self._sides)), tuple(map(tuple, self._ends)), times, scales)

    @property
    def sides(self) -> Sides:
        """The sides of the branch that the trajectory is in."""
        return self._sides[-1][-1]

    @property
    def corners(self) -> Corners:
        """The corners of the mode that the trajectory is in."""
        return self.branches.corners[self._mode]

    def evaluate(
        self, function: Function, t: float | FloatArray, x: FloatArray, inside: float | FloatArray
    ) -> FloatArray:
        """Evaluate a function of the mode at times () or (L,); an input is that of the cells that `inside`, () or (L,),
        is in.
        """
        moving, shape = [x], np.shape(t) + function.shape
        if function.takes_input:
            cells = np.clip(self._nodes.searchsorted(inside, "right") - 1, 0, len(self._signals) - 1)
            size = int(np.prod(self._structure.input_shape or ()))
            s, u, rate = np.expand_dims(np.subtract(t, self._nodes[cells]), -1), np.zeros(size), np.zeros(size)
            # Horner's scheme, for the input and its rate at once.
            for power in reversed(range(self._signals.shape[1])):
                rate, u = rate * s + u, u * s + self._signals[cells, power, self._signals.shape[-1] - size :]
            has_rate = function.structs[2].shape != self._structure.input_shape
            moving.append(np.concatenate([u, rate], axis=-1) if has_rate else u)
        found = trace_for_numpy(function)(t, moving, [self._named[name] for name in function.parameters])
        return found if found.shape == shape else np.broadcast_to(found, shape)  # it may be constant

    def enter(self, mode: int, t: float, x: FloatArray, inside: float) -> None:
        """Begin a segment in a mode from a time and a state."""
        self._mode, self._last = mode, None
        self._scale = self._guess_scale(t, x, inside)
        self._sides.append([self._choose((1,) * self.corners.count, t, x, inside, np.zeros(self.corners.count))])
        self._ends.append([])

    def _is_steep(self, corner: int) -> bool:
        return any(k == corner for (k, _), _ in self.corners.margins)

    def _guess_scale(self, t: float, x: FloatArray, inside: float) -> FloatArray:
        """Return how far g of each corner moves while one of the states moves by the largest value it has had."""
        self._largest = np.maximum(self._largest, np.abs(x))
        if not self.corners.count:
            return np.zeros(0)
        points = np.vstack([x, x + np.diag(self._largest)])
        surfaces = self.corners.surfaces((1,) * self.corners.count)
        with np.errstate(all="ignore"):
            g = self.evaluate(surfaces, np.full(len(points), t), points, np.full(len(points), inside))
            return np.nan_to_num(np.abs(g[1:] - g[0]).max(axis=0), posinf=0.0)

    def resume(self, t: float, x: FloatArray, inside: float, before: float) -> None:
        """Go on where an input may jump, from its value in the cell of a time before it: if the branch changes there,
        it does so at a known time.
        """
        # Where it slides g is zero up to errors of the solver: as large as it was before the input jumps.
        drift = np.abs(self.evaluate(self.corners.surfaces(self.sides), t, x, before)) if self.sides else np.zeros(0)
        after = self._choose(self.sides, t, x, inside, np.where(np.array(self.sides) == 0, drift, 0.0))
        if after != self.sides:
            self._add(t, -1, after)

    def cross(self, crossing: Crossing, inside: float) -> None:
        """Go on behind a crossing."""
        t, x, end = crossing
        # The branch behind the end that was passed, unless the rates of other corners there say another one.
        k, side = self.corners.list_ends(self.sides)[end]
        behind = (*self.sides[:k], side, *self.sides[k + 1 :])
        # Corners along which it slid are left by the errors that g has gathered there; the one that is crossed has the
        # error of its own location.
        drift = np.abs(self.evaluate(self.corners.surfaces(self.sides), t, x, inside))
        after = self._choose(behind, t, x, inside, np.where(np.array(self.sides) == 0, drift, drift[k]))
        if after == self.sides:
            # Its rate is too small to lead anywhere: the trajectory slides if the field behind the end leads back.
            leads_back = side * self.evaluate(self.corners.rates(behind), t, x, inside)[k] < 0
            may_rest = self.sides[k] != 0 and self.sides.count(0) < MOST_SLIDING and not self._is_steep(k)
            after = (*behind[:k], 0, *behind[k + 1 :]) if leads_back and may_rest else behind
        self._add(t, end, after)

    def _add(self, t: float, end: int, after: Sides) -> None:
        # Ever faster switching, as of a relay without a dead band, ends here and not in a solve without end.
        if len(self._times) >= self.branches.most:
            raise TooManyCrossingsError(
                f"mode {self._structure.mode_names[self._mode]!r} passes corners of the state ({self._list_lines()}) "
                f"more than {self.branches.most} times up to t = {t:.6g}: use a better guess, make them modes, or give "
                "them a dead band if they switch ever faster."
            )
        k, _ = self.corners.list_ends(self.sides)[end]
        self._scales.append(1.0 if self.sides[k] == 0 else float(self._scale[k]))
        self._times.append(t)
        self._ends[-1].append(end)
        self._sides[-1].append(after)
        self._last = None

    def _list_lines(self) -> str:
        return ", ".join(dict.fromkeys(filter(None, self.corners.lines)))

    def look_beyond(self, t: float, x: FloatArray, inside: float) -> None:
        """Make the corner at which a solver is stuck steep, if the field is undefined beyond it."""
        ends = self.corners.list_ends(self.sides)
        if ends:
            values = np.abs(self.evaluate(self.corners.ends(self.sides), t, x, inside))
            pairs = zip(values, ends, strict=True)
            near = {k for v, (k, _) in pairs if v <= STUCK_AT_CORNER * self._scale[k] and self.sides[k] != 0}
            undefined = [k for k in near if not self._is_defined_beyond(self.sides, k, t, x, inside)]
            self._make_steep([(k, self.sides[k]) for k in undefined])

    def _make_steep(self, corners: list[tuple[int, int]]) -> None:
        """Make corners steep on a side, if there are any that are not: the path has to be found anew."""
        corners = [each for each in corners if each not in dict(self.corners.margins)]
        if corners:
            # Powers of ten: programs have the margins in them, and are kept for other guesses.
            sizes = [10.0 ** round(np.log10(STEEP_MARGIN * (self._scale[k] or 1.0))) for k, _ in corners]
            self.branches.make_steep(self._mode, dict(zip(corners, sizes, strict=True)))
            raise SteepError

    def _is_defined_beyond(self, sides: Sides, k: int, t: float, x: FloatArray, inside: float) -> bool:
        """Return whether the field of a branch is finite beyond its corner k, which x is near."""
        with np.errstate(all="ignore"):
            return bool(np.isfinite(self.evaluate(self.corners.beyond(sides, k), t, x, inside)).all())

    def list_ends(self, mode: int, sides: Sides) -> tuple[list[int], BoolArray]:
        """Return the corners of the ends of a branch, and which of them it slides along."""
        of_end = [k for k, _ in self.branches.corners[mode].list_ends(sides)]
        return of_end, np.array([sides[k] == 0 for k in of_end])

    def look(self, times: FloatArray, states: FloatArray) -> Crossing | None:
        """Return where steps between states (L + 1, n) at times (L + 1,) leave the branch; None if they do not."""
        if not self.sides or len(times) < 2:
            return None
        function, inside = self.corners.ends(self.sides), 0.5 * float(times[0] + times[-1])
        self._largest = np.maximum(self._largest, np.abs(states).max(axis=0))
        if self._last is None:
            self._last = self.evaluate(function, times[:1], states[:1], inside)
            # A corner along which the trajectory slid is left from a state on a cubic: it may be a little beyond.
            self._beyond = 2.0 * np.minimum(self._last[0], 0.0)
        known = len(self._last)
        # The values of the two states before are kept: a dip shows by how values change on both sides of a step.
        values = np.concatenate([self._last, self.evaluate(function, times[1:], states[1:], inside)])
        dips, values = np.asarray(find_dips(values))[known - 1 :], values[known - 1 :]
        of_end, slides = self.list_ends(self._mode, self.sides)
        scale = np.maximum.accumulate(np.maximum(np.abs(values), self._scale[of_end]))[1:]
        # Relative to what each function is seen to reach: g to its largest value so far, s of a sliding corner to 1.
        # Beside a steep corner a trajectory is slow, but not on the other side, where tanks are empty up to errors.
        margins = dict(self.corners.margins)
        steep = np.array([(k, self.sides[k] or 1) in margins or (k, self.sides[k] or -1) in margins for k in of_end])
        limits = np.minimum(-np.where(steep, PASSED_STEEP, PASSED) * np.where(slides, 1.0, scale), self._beyond)
        # Negative at the end of the step, or possibly in between: only these are looked at on the cubic.
        suspects = (dips | (values[1:] < limits)).any(axis=1)
        last = len(times) - 2
        for row in np.flatnonzero(suspects).tolist():
            found = self._find(times[row : row + 2], states[row : row + 2], limits[row], inside)
            if found is not None and not self._returns(found, inside):
                last = row
                break
        else:
            found = None
        np.maximum.at(self._scale, of_end, np.where(slides, 0.0, scale[last]))
        self._last = values[last : last + 2]
        return found

    def _returns(self, crossing: Crossing, inside: float) -> bool:
        """Return whether the field leads back from a steep corner, which is passed by an error of the solver then."""
        k, _ = self.corners.list_ends(self.sides)[crossing.end]
        rates = self.corners.rates(self.sides)
        return self._is_steep(k) and self.sides[k] * self.evaluate(rates, crossing.time, crossing.state, inside)[k] > 0

    def leaves(self, mode: int, sides: Sides, times: FloatArray, states: FloatArray, limits: FloatArray) -> bool:
        """Return whether the functions of the ends of a branch fall below `limits` in a step between two states."""
        self._mode, self._sides = mode, [[sides]]
        return self._find(times, states, limits, 0.5 * float(times[0] + times[1])) is not None

    def _find(self, times: FloatArray, states: FloatArray, limits: FloatArray, inside: float) -> Crossing | None:
        """Return where a step leaves the branch, on the cubic through both of its ends; None if it does not."""
        function, branch = self.corners.ends(self.sides), self.corners.branch(self.sides)
        t0, h, (x0, x1) = float(times[0]), float(times[1] - times[0]), states
        # Cubic Hermite interpolation of the step (Hairer, Norsett and Wanner I, section II.6): states and slopes at
        # both ends.
        f0, f1 = self.evaluate(branch, times, states, inside)

        def state_at(s: FloatArray) -> FloatArray:
            """Return the states at parts s (L,) of the step: (L, n)."""
            r = s[:, None]
            bend = (1 - 2 * r) * (x1 - x0) + h * ((r - 1) * f0 + r * f1)
            return np.asarray((1 - r) * x0 + r * x1 + r * (r - 1) * bend)

        def values_at(s: FloatArray) -> FloatArray:
            found = self.evaluate(function, t0 + h * s, state_at(s), inside)
            return np.where(np.isfinite(found), found, np.inf)

        def narrow(low: float, high: float, limits: FloatArray) -> tuple[float, float, BoolArray]:
            """Return the first part of a grid at whose end a function is below its limit, and which of them are."""
            s = np.linspace(low, high, PARTS_OF_STEP + 1)[1:]
            passed = values_at(s) < limits
            row = int(passed.any(axis=1).argmax())
            return s[row - 1] if row else low, s[row], passed[row]

        # Three rounds of a grid narrow the first passage down to h / 16^3; one step of the secant method does the rest.
        low, high = 0.0, 1.0
        for _ in range(3):
            low, high, passed = narrow(low, high, limits)
            if not passed.any():
                return None
        end = int(passed.argmax())
        # The function has passed zero before its limit, where the trajectory is nearly a tangent far before it.
        zero = np.where(np.arange(len(limits)) == end, 0.0, -np.inf)
        if values_at(np.zeros(1))[0, end] > 0.0:
            start = 0.0
            for _ in range(3):
                start, high, _ = narrow(start, high, zero)
            low = start
        below, above = values_at(np.array([low, high]))[:, end]
        part = low + (high - low) * min(max(below / (below - above), 0.0), 1.0) if below > above else high
        return Crossing(t0 + h * float(part), state_at(np.array([part]))[0], end)

    def _choose(self, sides: Sides, t: float, x: FloatArray, inside: float, drift: FloatArray) -> Sides:
        """Return the sides of the branch in which a trajectory goes on; at corners from the rates of both sides.

        `sides` are those to begin with; at a corner that repels to both sides, the trajectory takes that one. `drift`
        is the error of g of each corner.
        """
        # As many rounds as decisions can follow from one another; rates that contradict each other go round for ever.
        for _ in range(2 * len(sides) + 2):
            # Sides from the signs of g; where g is zero up to rounding, from its rates on both sides. One decision may
            # change the field, and with it another: each is made with those before it, until nothing changes.
            g = self.evaluate(self.corners.surfaces(sides), t, x, inside) if sides else np.zeros(0)
            is_near, before, at = np.abs(g) <= AT_CORNER * self._scale + 2.0 * drift, sides, x
            # Tanks that run empty at the same time are at rest: what errors of their levels let flow between them is
            # not there at the corners themselves.
            for k in filter(self._is_steep, np.flatnonzero(is_near).tolist()):
                at = self.evaluate(self.corners.onto(sides, k), t, at, inside)
            for k in range(len(sides)):
                side = self._decide(sides, k, t, at, inside) if is_near[k] else 1 if g[k] > 0 else -1
                sides = (*sides[:k], side, *sides[k + 1 :])
            if sides == before:
                break
        steep = [self._is_steep(k) for k, side in enumerate(sides) if side == 0]
        for most, count in ((MOST_SLIDING, len(steep)), (MOST_STEEP, sum(steep))):
            if count > most:
                raise NotIntegrableError(
                    f"mode {self._structure.mode_names[self._mode]!r} slides along more than {most} corners of the "
                    f"state at a time ({self._list_lines()}) at t = {t:.6g}: make rest a mode of its own."
                )
        return sides

    def _decide(self, sides: Sides, k: int, t: float, x: FloatArray, inside: float) -> int:
        """Return the side of a corner at which the trajectory is: 0 if it slides."""
        both = [(*sides[:k], side, *sides[k + 1 :]) for side in (1, -1)]
        # A row that begins at a corner beyond which its field is undefined has no derivatives: sqrt(x) from x = 0.
        if self.branches.meet(self._mode, k, both[0]):
            self._make_steep([(k, each[k]) for each in both if not self._is_defined_beyond(each, k, t, x, inside)])
        if self._is_steep(k):
            # At the corner itself, both rates may vanish as those of other corners do not: no side is better. Else the
            # rates on the margin decide as for any corner, since they are those that move the trajectory.
            margins = tuple((at, NEAR_STEEP * margin) for at, margin in self.corners.margins)
            near = find_corners(self.corners.function, margins)
            exact = np.abs([self.evaluate(near.rates_at(each, k), t, x, inside) for each in both])
            if exact[:, k].max() <= STILL_STEEP * exact.max():
                return sides[k] or 1
        up, down = (self.evaluate(self.corners.rates(each), t, x, inside)[k] for each in both)
        # dg/dt on the side +1 and on the side -1. Both point away: the side that it is on. One points through: that
        # way. Both point to the corner: it slides (Filippov).
        still = STILL * max(abs(up), abs(down))
        for is_up, is_down in ((up > still, down < -still), (abs(up) <= still, abs(down) <= still)):
            if is_up or is_down:
                return (sides[k] or 1) if is_up and is_down else 1 if is_up else -1
        return 0


def find_dips(values: FloatArray) -> BoolArray:
    """Return in which steps, (L, E), functions with these values (L + 1, E) may have been negative, but at both ends.

    They fall before the step and rise after it, and change by much of their size in it or beside it.
    """
    # NaN, unknown, before the first and after the last step: a comparison with it is false, so that it excludes
    # nothing.
    change = np.diff(values, axis=0, prepend=np.nan, append=np.nan)
    before, inside, after = change[:-2], change[1:-1], change[2:]
    largest = np.fmax(np.fmax(np.abs(before), np.abs(after)), np.abs(inside))
    return ~(before > 0.0) & ~(after < 0.0) & (np.minimum(values[:-1], values[1:]) < 2.0 * largest)
