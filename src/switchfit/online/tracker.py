"""The hypotheses of an online estimator: one step at a time, anew over the window, and out of it.

A *node* is a time at which something was measured, or between two such times. At each node the hypotheses that were
kept have children in all modes that may follow, which go on to the next node together with their parents.

The window begins at a `Start`: hypotheses that disagree with the best one about what was before are dropped.
"""

from __future__ import annotations

import io
import json
import operator
from collections import deque
from itertools import accumulate
from math import nextafter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.engine.hypotheses import Column, Hypotheses, HypothesisLimits
from switchfit.online.feed import Feed
from switchfit.online.files import ONLINE_FORMAT
from switchfit.online.information import drop_artificial, invert
from switchfit.online.window_start import Past, Start, forget
from switchfit.strategy.beam import Beam, Pass
from switchfit.strategy.sequences import Integers, Rules, Sequences, encode, select_lowest

KEPT_NODES = 32
"""Nodes whose hypotheses are kept, to go on from them where a sample comes late."""

MOST_OF_ONE_SEQUENCE = 8
"""Hypotheses with the same sequence that are kept, at most. Of fewer, those that fit the noise of the last second best
leave no room for a change that begins."""

REFUTED_FROM = 200.0
"""Rise of 2 J without a change from which on it is not looked at anew: what is not fitted anew is too high by less."""

LONGEST_APART = 2.0
"""How far a transition time of two hypotheses may differ, in times between samples, where it leaves the window."""

MOST_REPEATED = 12
"""Hypotheses that go on where all are propagated anew over the window: parameters get new values, or a sample comes so
late that the hypotheses at the node before it are not kept."""


class StoppedError(ValueError):
    """No hypothesis can be simulated from a time on."""

    def __init__(self, t: float) -> None:
        super().__init__(
            f"the model cannot be simulated from t = {t:.9g} on, in no mode: see whether y, u and the model are "
            "finite, then begin anew with reset()."
        )
        self.t = t


class Left(NamedTuple):
    """A transition that has left the window: the mode before it, its time, and its standard error."""

    mode: int
    time: float
    error: float


class Kept(NamedTuple):
    """Hypotheses at a node, and the `shift` of the tracker, (A,), from which the entries e of their `moved` count."""

    sequences: Sequences
    found: Hypotheses
    shift: FloatArray


class TrackerSettings(NamedTuple):
    """How hypotheses are followed.

    Attributes
    ----------
    rules : Rules
    births : int, S, the largest number of switches in the window
    entries : int, A, unknowns for what is before the window
    width : int
    penalty : float, price of a switch in units of J
    """

    rules: Rules
    births: int
    entries: int
    width: int
    penalty: float


class Tracker:
    """The hypotheses on the samples of a feed.

    Parameters
    ----------
    beam : Beam
        With room for A + S births.
    settings : Settings
    parameters : (U,)
        Point of linearisation at the beginning.
    feed : Feed

    Attributes
    ----------
    first, node : int
        Node at which the window begins, and the last one to which hypotheses were taken; -1 before there are any.
    kept : deque of Kept
        Those at the last nodes.
    shift : (A,)
        By how much the entries e have moved on with the start of the window.
    declared : (k + 1,) int
        Places of the modes since then that were declared.
    left : list of Left
    spacing : float
        Time between samples.
    birth_information : float
        Second derivative of the cost along a time that a birth begins with.
    artificial : (D,)
        What the diagonal of H has that is no knowledge.
    """

    def __init__(self, beam: Beam, settings: TrackerSettings, parameters: FloatArray, feed: Feed) -> None:
        self.beam, self.settings, self.feed = beam, settings, feed
        self.first, self.node, self.spacing = 0, -1, beam.grid
        self.declared: NDArray[np.int64] = settings.rules.first[:1]
        self.left: list[Left] = []
        self.start: Start | None = None
        self.kept: deque[Kept] = deque(maxlen=KEPT_NODES)
        self.shift = np.zeros(settings.entries)
        self._pass = Pass(beam, settings.rules, parameters, settings.penalty)
        # What H has that is no knowledge: a time that a birth begins with is known to half a spacing.
        self.birth_information = float(12.0 * (beam.noise / beam.reaches[0]) ** 2)
        # Without a prior a parameter has a weak one, which keeps H positive before the data do; it is taken out again
        # of what is said.
        weak = np.where(beam.priors.precision > 0, 0.0, (beam.noise / self._pass.spread) ** 2)[beam.places]
        of_births = np.full(beam.births, self.birth_information)
        of_births[: settings.entries] = 0.0
        self.artificial = np.concatenate([of_births, weak])
        self._artificial = np.diag(self.artificial)
        self._slots, self._parameters = np.arange(settings.births), parameters[beam.places]

    # --- one step --------------------------------------------------------------------------------------------------

    @property
    def latest(self) -> tuple[Sequences, Hypotheses]:
        """The hypotheses at the last node, whose arrays may be written to."""
        self.kept[-1] = there = self._catch_up(self.kept[-1])
        return there.sequences, there.found

    def _catch_up(self, there: Kept) -> Kept:
        """Let the entries e of hypotheses begin where the window does now."""
        if there.shift is not self.shift:
            # The start moves with every update, while hypotheses of earlier nodes are needed only where a sample comes
            # late: what they have missed is added then.
            there.found.moved[:, : len(self.shift)] += self.shift - there.shift
        return there._replace(shift=self.shift)

    def _keep(self, sequences: Sequences, records: FloatArray) -> Kept:
        """Return hypotheses as they are kept, with records of their own."""
        return Kept(sequences, self.beam.engine.view(records), self.shift)

    def value(self, switches: Integers, found: Hypotheses) -> FloatArray:
        """Return the cost of hypotheses with the price of their switches; not finite where they have failed."""
        value: FloatArray = found.scores + self.settings.penalty * switches
        return value

    def find_best(self, kept: Sequences, found: Hypotheses, value: FloatArray) -> tuple[int, int | None, int | None]:
        """Return which of the hypotheses that are kept is best, which of those with exactly what was declared, and
        which of those that have more after it: none in which a mode would last less than no time, unless declared.
        """
        last = len(self.declared) - 1
        # Of sequences that begin as was declared; `exact` has no change after it, `further` one or more.
        same = (kept.modes[:, : last + 1] == self.declared).all(1)
        exact = (same & (kept.switches == last)).nonzero()[0]
        others = value.argsort().tolist()  # those that have failed come last
        # Where no hypothesis has its times in order, the lowest one still has to say something.
        best = next((b for b in others if self._is_ordered(kept, found, b)), others[0])
        further = (same & (kept.switches > last)).tolist()
        more = (b for b in others if further[b] and self._is_ordered(kept, found, b))
        if not len(exact):
            return best, None, next(more, None)
        own = int(exact[value[exact].argmin()])
        # What was declared counts even with times out of order: its cost alone retracts an alarm.
        return own if value[own] < value[best] else best, own, next(more, None)

    def _is_ordered(self, kept: Sequences, found: Hypotheses, b: int) -> bool:
        """Return whether the births of a hypothesis follow one another, and are not after now."""
        count, A = int(kept.switches[b]), self.settings.entries
        times = (kept.times[b, :count] + found.moved[b, A : A + count]).tolist()
        return all(map(operator.le, times, [*times[1:], float(self.feed.nodes[self.node])]))

    def advance(self, changed: int, births: bool) -> None:
        """Take all hypotheses to the last node of the feed, of which those from `changed` on are new, or have samples
        that are.
        """
        late = self.node + 1 - changed
        # The hypotheses at the node before the late sample are not kept any more: all is propagated anew over the
        # window.
        if changed and late >= len(self.kept) > 0:
            self.repeat(*self.latest)
            return
        for _ in range(min(late, len(self.kept))):
            self.kept.pop()
        self.node = min(self.node, changed - 1)
        while self.node + 1 < self.feed.count:
            self.step(births)

    def step(self, births: bool) -> None:
        """Take all hypotheses to the next node."""
        beam, (rules, S, A, _, _) = self.beam, self.settings
        node = self.node + 1
        if node == 0:
            kept = Sequences.start(rules.first, S, float(self.feed.nodes[0]))
            # At node 0 there is nothing but priors; the engine gets its tolerances and limits here.
            start = self._pass.build_start(np.zeros((1, beam.births + len(beam.places))))
            found = beam.engine.begin(self._parameters, start, beam.tolerances, self._build_limits())
            self.kept.append(self._keep(kept, found.records))
            self.node = 0
            return
        kept, found = self.latest
        t, B = float(self.feed.nodes[node - 1]), len(kept.mode)
        parents, after = rules.list_births(kept, t, np.inf)
        children = kept.list_children(parents, after) if births else kept.list_children(parents[:0], after[:0])
        # Rows: the parents that go on in their mode, then the children that change it at this node.
        table = self._pass.build_table(kept, children, np.arange(B))
        # The first A unknowns stand for what is before the window: births have the slots behind them.
        table[B:, Column.SLOT] += A
        found = beam.engine.advance(found, table, node - 1, node)
        chosen = self._select(self.value(children.switches, found), children.code, children.switches)
        # No finite score in any mode: the state, or its derivative, is not finite.
        if not len(chosen):
            raise StoppedError(t)
        self.kept.append(self._keep(kept.follow(children, chosen, t), found.records[chosen]))
        self.node = node

    def _select(self, value: FloatArray, code: Integers, switches: Integers) -> Integers:
        """Return the best hypotheses, those that are always kept among them."""
        chosen = select_lowest(value, code, switches, self.settings.width, MOST_OF_ONE_SEQUENCE)
        # What was declared, and where there are more modes in the window, that without the last one or two.
        modes = [*(each.mode for each in self.left), *self.declared.tolist()]
        # A change cannot be refuted by hypotheses that were dropped: what was declared, and without its last changes,
        # goes on however bad it looks for a moment.
        there = code[chosen].tolist()  # if any of a sequence, then its best
        for own in [encode(modes), encode(modes[:-1]), encode(modes[:-2])][: len(self.declared)]:
            if own not in there:
                same = np.flatnonzero((code == own) & np.isfinite(value))
                chosen = np.append(chosen, same[value[same].argsort(kind="stable")[:1]])
        return chosen

    def _build_limits(self) -> HypothesisLimits:
        """Return how far times and parameters may move; what is before the window may move anywhere."""
        low, high, most = self._pass.build_limits()
        # A birth at each node: its time moves by up to one spacing, beyond which another node's birth is responsible.
        reach = np.full(self.beam.births, self.spacing)
        reach[: self.settings.entries] = np.inf
        for values, sign in ((low, -1.0), (high, 1.0), (most, 1.0)):
            values[: len(reach)] = sign * reach
        return HypothesisLimits(low, high, most)

    # --- over the window -------------------------------------------------------------------------------------------

    def times(self, kept: Sequences, moved: FloatArray) -> FloatArray:
        """Return the times of all births where they have `moved` (B, D), in order: (B, S)."""
        A = self.settings.entries
        return np.maximum.accumulate(kept.times + moved[:, A : A + self.settings.births], axis=1)

    def _propagate(
        self, kept: Sequences, moved: FloatArray, times: FloatArray, births: Integers | int, last: int, *,
        recentres: bool,
    ) -> Hypotheses:  # fmt: skip
        """Return hypotheses from the start of the window anew to a node, with so many births (B,) at times (B, S)."""
        start, (_, S, A, _, _) = self.start, self.settings
        moved = moved.copy()
        # Births are where they have moved; the entries e and the parameters stay moved, and the start follows them.
        moved[:, A : A + S] = 0.0
        # A start has knowledge alone; hypotheses have H_0 of births and weak terms beside it.
        # Until something has left, the start is t0 with its priors, as of a beam along a log.
        begun = self._pass.build_start(moved) if start is None else start.build(moved, self._artificial)
        first = None if start is None else self.first
        return self._pass.propagate(begun, kept, births, times, last, first, recentres=recentres)

    def polish(self) -> None:
        """Propagate the hypotheses that decide anew, from where they have moved."""
        last = self.node
        # The window has no stretch to be propagated over.
        if last <= self.first:
            return
        kept, found = self.latest
        value = self.value(kept.switches, found)
        # Three at most, and two more below: all of them over the window would take longer than the update itself.
        best = {b for b in self.find_best(kept, found, value) if b is not None}
        # A change can be refuted only where the modes before it fit as well as they can.
        doubted = 2.0 * (value - value.min()) < REFUTED_FROM
        for modes in (self.declared[:-1], self.declared[:-2]):
            same = doubted & (kept.switches == len(modes) - 1) & (kept.modes[:, : len(modes)] == modes).all(1)
            if same.any():
                best.add(int(np.where(same, value, np.inf).argmin()))
        chosen = np.array(sorted(best))
        own, moved = kept.take(chosen), found.moved[chosen]
        times, latest = self._place_births(own, moved, float(self.feed.nodes[last]))
        anew = self._propagate(own, moved, times, own.switches, last, recentres=True)
        good = np.isfinite(anew.scores)
        chosen = chosen[good]
        # In place, so that later nodes go on from there. One that failed keeps what it was.
        found.records[chosen] = anew.records[good]
        kept.times[chosen], kept.last[chosen] = times[good], latest[good]

    # --- out of the window -----------------------------------------------------------------------------------------

    def leave(self) -> None:
        """Move the start of the window to the next node."""
        feed, (_, S, A, _, _) = self.feed, self.settings
        following = self.first + 1
        kept, found = self.latest
        b = int(self.value(kept.switches, found).argmin())
        own, moved = kept.take(slice(b, b + 1)), found.moved[b : b + 1].copy()
        end = float(feed.nodes[following])
        times, _ = self._place_births(own, moved, np.inf)
        # Transitions of the best hypothesis before the new start; those of others that differ are dropped by `_follow`.
        gone = sum(time < end for time in times[0, : own.switches[0]].tolist())
        # The best hypothesis alone says what was before the new start: x, Z, J, g and H at the node, without moving on.
        there = self._propagate(own, moved, times, gone, following, recentres=False)
        # The error that is reported for good once the transition has left: without H_0, which is no knowledge.
        known = drop_artificial(found.matrices[b], self.artificial)
        errors = np.sqrt(np.diag(invert(known)))[A : A + gone] if gone else np.zeros(0)
        # The new start is the point of linearisation of times and e; parameters keep where they have moved.
        there.moved[:, : A + S] = 0.0
        pasts = []
        # Transitions that are behind the new start become entries e, one after the other; for each one combination of n
        # + 1 directions has no effect on the state, and is eliminated (`window_start`).
        for _ in range(gone):
            pasts.append(Past.of(there.tangents[0], A, S))
            pasts[-1].absorb(there, self.birth_information)
        x, Z, g = there.states[0].copy(), there.tangents[0].copy(), there.gradients[0].copy()
        H = there.matrices[0] - self._artificial
        self.start = Start(there.moved[0].copy(), float(there.costs[0]), g, H, x, Z)
        modes = own.modes[0, : gone + 1]
        self.left += map(Left, modes[:gone].tolist(), times[0, :gone].tolist(), errors.tolist())
        # e counts from the new x_w, to which the best hypothesis' own e has moved.
        self.shift = self.shift - moved[0, :A]
        # Without a transition, hypotheses of earlier nodes that disagree are dropped once they have come to the last.
        # With a transition that leaves, the arrays of every kept node must change their slots; without one they may
        # wait.
        count, followed = (self.node - following + 1 if pasts else 1), deque[Kept](maxlen=KEPT_NODES)
        while self.kept and len(followed) < count:
            agreeing = self._follow(self.kept.pop(), pasts, modes, times[0, :gone], end)
            if agreeing is None:
                break
            followed.appendleft(agreeing)
        # What is before a node without an agreeing hypothesis is lost: a sample that comes so late takes `repeat`.
        self.kept = followed if pasts else self.kept + followed
        self.first = following
        if gone:
            self.declared = self.declared[gone:]

    def _follow(
        self, there: Kept, pasts: list[Past], modes: NDArray[np.int64], times: FloatArray, end: float
    ) -> Kept | None:
        """Return the hypotheses of a node that agree about what has left the window, by its new start; None without.

        Parameters
        ----------
        there : Kept
        pasts : list of Past, for each of k transitions that have left
        modes, times : (k + 1,) int, (k,)
        end : float, time of the start
        """
        A, k = self.settings.entries, len(pasts)
        there = self._catch_up(there)
        kept, found, _ = there
        # No birth that could lie before the start: all agree, and nothing is copied, as in most updates.
        is_early = kept.times[:, 0] + found.moved[:, A] < end
        if not pasts and not kept.switches[is_early].any():
            return there
        own = self.times(kept, found.moved)
        is_born = self._slots < kept.switches[:, None]
        # The same modes before the new start, at about the same times, and no birth of the others before it.
        agrees = (kept.modes[:, : k + 1] == modes).all(1) & (kept.switches >= k)
        begin = float(self.feed.nodes[self.first])  # times may have moved to before it
        agrees &= (np.abs(np.maximum(own[:, :k], begin) - times) <= LONGEST_APART * self.spacing).all(1)
        agrees &= ~(is_born & (own < end))[:, k:].any(1)
        chosen = np.flatnonzero(agrees)
        if not len(chosen):
            return None
        kept, found, shift = self._keep(kept.take(chosen), found.records[chosen])
        # Times that have left are measured from those of the best hypothesis, at which the new start was made.
        found.moved[:, A : A + k] = own[chosen, :k] - times
        for past in pasts:
            past.absorb(found, self.birth_information)
        if k:
            # The first k modes and times have left, and the last slots are free; codes still count what has left.
            rolled = np.roll(kept.modes, -k, axis=1), np.roll(kept.times, -k, axis=1)
            for array in rolled:
                array[:, -k:] = 0
            kept = kept._replace(modes=rolled[0], times=rolled[1], switches=kept.switches - k)
        return Kept(kept, found, shift)

    def renew(self, chosen: NDArray[np.intp], variances: FloatArray) -> None:
        """Give parameters new values from the start of the window on, which differ from the old ones by `variances`.

        Parameters
        ----------
        chosen : (m,) int
            Positions among the D unknowns.
        variances : (m,)
        """
        if self.start is None:
            raise ValueError("nothing has left the window yet")
        A, center, new = self.settings.entries, self.start.moved, chosen[np.isinf(variances)]
        self.start, turn = forget(self.start, A, chosen, variances)
        begun = self._pass.build_start(center[None])  # of new values, their priors are known
        self.start.gradient[new] += begun.gradients[0, new]
        self.start.matrix[new, new] += (np.diag(begun.matrices[0]) - self.artificial)[new]
        kept, found = self.latest
        # Each hypothesis' own e and old parameters, in the new entries.
        found.moved[:, :A] = np.hstack([found.moved[:, :A], found.moved[:, chosen] - center[chosen]]) @ turn
        self.repeat(kept, found)

    def repeat(self, kept: Sequences, found: Hypotheses) -> None:
        """Propagate the best of some hypotheses anew over the window, up to the last node; those of others are lost."""
        last = self.feed.count - 1
        best = self._select(self.value(kept.switches, found), kept.code, kept.switches)[:MOST_REPEATED]
        kept, found = kept.take(best), found.take(best)
        times, latest = self._place_births(kept, found.moved, float(self.feed.nodes[last]))
        anew = self._propagate(kept, found.moved, times, kept.switches, last, recentres=True)
        good = np.flatnonzero(np.isfinite(anew.scores))
        if not len(good):
            raise StoppedError(float(self.feed.nodes[self.first]))
        # Hypotheses of earlier nodes are not those of the new values: a late sample goes back no further than this.
        self.kept.clear()
        self.kept.append(self._keep(kept._replace(times=times, last=latest).take(good), anew.records[good]))
        self.node = last

    def _place_births(self, kept: Sequences, moved: FloatArray, end: float) -> tuple[FloatArray, FloatArray]:
        """Return where births have `moved` (B, D) between the start of the window and an end, in order, (B, S), and
        when each sequence began its last mode, (B,).
        """
        A, begin = self.settings.entries, float(self.feed.nodes[self.first])
        # A birth at the last node itself has had no sample yet, and its derivative would be zero.
        before, times, last = nextafter(end, begin), np.zeros(kept.times.shape), kept.last.copy()
        free = (kept.times + moved[:, A : A + self.settings.births]).tolist()
        for b, count in enumerate(kept.switches.tolist()):  # of few: fast without arrays
            if count:
                inside = [min(max(time, begin), before) for time in accumulate(free[b][:count], max)]
                times[b, :count], last[b] = inside, inside[-1]
        return times, last

    def drop_nodes(self) -> None:
        """Give back the room of the nodes before the window."""
        self.feed.drop(self.first)
        self.node -= self.first
        self.first = 0

    # --- files -----------------------------------------------------------------------------------------------------

    def pack(self, others: dict[str, Any]) -> bytes:
        """Return all arrays, and other numbers, as a file."""
        arrays: dict[str, Any] = {f"feed {name}": array for name, array in self.feed.copy_arrays().items()}
        for k, (sequences, found, shift) in enumerate(self.kept):
            # Records are the engine's memory as it stands: the same program goes on from them, bit for bit.
            own = sequences._asdict() | {"records": found.records, "shift": shift}
            arrays |= {f"kept {k} {name}": array for name, array in own.items()}
        arrays |= {"shift": self.shift, "declared": self.declared}
        if self.start is not None:
            arrays |= {f"start {name}": np.asarray(array) for name, array in self.start._asdict().items()}
        numbers = others | {"format": ONLINE_FORMAT, "first": self.first, "node": self.node, "left": self.left}
        buffer = io.BytesIO()
        np.savez(buffer, numbers=np.frombuffer(json.dumps(numbers).encode(), dtype=np.uint8), **arrays)
        return buffer.getvalue()

    def unpack(self, numbers: dict[str, Any], arrays: dict[str, FloatArray]) -> None:
        """Take what was saved."""

        def part(name: str) -> dict[str, Any]:
            begin = f"{name} "
            return {key.removeprefix(begin): array for key, array in arrays.items() if key.startswith(begin)}

        self.feed.set_arrays(part("feed"))
        self.declared, self.shift = arrays["declared"].astype(np.int64), arrays["shift"]
        self.kept.clear()
        while own := part(f"kept {len(self.kept)}"):
            records, shift = own.pop("records"), own.pop("shift")
            self.kept.append(Kept(Sequences(**own), self.beam.engine.view(records), shift))
        if start := part("start"):
            self.start = Start(**start)._replace(cost=float(start["cost"]))
        self.first, self.node = numbers["first"], numbers["node"]
        self.left = [Left(*each) for each in numbers["left"]]
