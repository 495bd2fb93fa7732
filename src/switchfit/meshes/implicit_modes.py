"""Choose the modes of an experiment that take implicit steps, for ``Problem(solver="auto")``.

A mode that is stiff at one of the thetas is solved by the implicit method too, which it keeps if its rows take less
time; the other modes take explicit steps all the same. The time of a row is its *work*, in additions: the operations of
its machine code are counted, so that the choice is the same in each process. The implicit rows of small models have
three to five times the work of explicit ones, and take 0.65 to 0.9 times as long as their work says; those of 12 states
that all depend on one another have eighteen times the work.

A fit may reach a theta where a mode is stiff and the explicit steps of its mesh are unstable: it then cannot go on.
After such a failure, the eigenvalues at that theta are compared with the mesh.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

from switchfit.discretization.stiffness import Stiffness
from switchfit.engine.adaptive.stiffness import Watch

STEPS_BETWEEN_AFTER_FAILURE = 64
"""The same after a fit has failed, to find out whether its mesh is unstable."""

UNSTABLE = 1.5
"""Factor by which explicit steps at the limit of stability count more: they are unstable on a mesh that is a bit
coarser, or as soon as theta moves (Van der Pol's oscillator with mu = 100: J is NaN at the guess, and finite on a mesh
of twice as many cells)."""


class ImplicitModes:
    """The modes of one experiment that take implicit steps, while it is solved at several thetas until none is added.

    Parameters
    ----------
    stiffness : iterable of Stiffness
        Modes that take implicit steps already.

    Attributes
    ----------
    found : dict of str to Stiffness
        The modes that take implicit steps, and why.
    watches : list of Watch
        Of the last solve at each theta.
    """

    def __init__(self, stiffness: Iterable[Stiffness] = ()) -> None:
        self.found = {each.mode: each for each in stiffness}
        self._most: dict[str, tuple[int, float]] = {}  # where a mode was found, and the work it may have there
        self._refused: set[str] = set()
        self.watches: list[Watch] = []

    @property
    def stiffness(self) -> tuple[Stiffness, ...]:
        """The modes that take implicit steps, and why."""
        return tuple(self.found.values())

    def watch(self, k: int) -> Watch:
        """Return the watch of a solve at the k-th theta. At the theta where a mode was found, its work is limited."""
        # Elsewhere the explicit steps of the mode are not known: nothing is compared there.
        watch = Watch({name: most for name, (at, most) in self._most.items() if at == k}, refused=self._refused)
        self.watches = [*self.watches[:k], watch]
        return watch

    def has_limits(self) -> bool:
        """Return whether stability limits explicit steps of a mode in one of the last solves."""
        return any(mode.limited for watch in self.watches for mode in watch.modes.values())

    def add(self, stiff: Mapping[str, float], explicit: Watch, k: int) -> bool:
        """Let modes take implicit steps, and return whether there is one among them that did not.

        They keep them if these take less time there than the explicit ones.

        Parameters
        ----------
        stiff : mapping of str to float
            ``|lambda| h`` of their explicit steps.
        explicit : Watch
            Of the explicit solve at the k-th theta.
        k : int
        """
        # Refused modes stay refused: else two kinds of steps, each of which takes longer than the other said, would
        # alternate.
        new = {name: ratio for name, ratio in stiff.items() if name not in self.found and name not in self._refused}
        for name, ratio in new.items():
            steps = explicit.modes[name]
            self.found[name], self._most[name] = Stiffness(name, steps.total, 0, ratio), (k, UNSTABLE * steps.work)
        return bool(new)

    def refuse(self, name: str) -> bool:
        """Let a mode take explicit steps after its implicit ones have failed; return whether it took implicit ones."""
        self._refused.add(name)
        # Also its limit: the next solve of the mode counts explicit steps, which are compared with nothing.
        self._most.pop(name, None)
        return self.found.pop(name, None) is not None

    def count_steps(self, watch: Watch, k: int) -> bool:
        """Record the implicit steps that a solve at the k-th theta took in the modes that were found there; refuse
        those whose rows take longer than explicit ones, and return whether there is one.
        """
        # Only where a mode was found stiff are both kinds of steps known, at one theta: there they are compared by
        # work.
        found = {name: most for name, (at, most) in self._most.items() if at == k and name in watch.modes}
        for name in found:
            self.found[name] = replace(self.found[name], implicit_steps=watch.modes[name].total)
        slower = [name for name, most in found.items() if watch.modes[name].work > most]
        for name in slower:
            self.refuse(name)
        return bool(slower)
