"""Costs of the trajectory, of its end and of transitions, and constraints on its end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from switchfit.arrays import Traced
from switchfit.problem.validation.names import as_name
from switchfit.problem.validation.objects import as_callable


@dataclass(frozen=True, eq=False)
class RunningCost:
    """Incremental cost: adds ``integral of ell(t, x, p) dt`` over ``[t0, tf]`` to J, equation (2).

    Parameters
    ----------
    ell : callable ``ell(t, x, p) -> scalar``, twice differentiable in x and p.

    See Also
    --------
    TerminalCost, TransitionCost, ReferenceSignal

    Examples
    --------
    >>> effort = sf.RunningCost(lambda t, x, p: x[0] ** 2)
    >>> run = sf.Experiment(effort, ("on", "off"), (2.0,), 0.0, 4.0)
    >>> len(run.data)
    1
    """

    ell: Callable[..., Traced]

    def __post_init__(self) -> None:
        as_callable(self.ell, "RunningCost", "a function ell(t, x, p)")


@dataclass(frozen=True, eq=False)
class TerminalCost:
    """Cost of the final state: adds ``phi(x(tf), p)`` to J.

    Parameters
    ----------
    phi : callable ``phi(x, p) -> scalar``, twice differentiable.

    See Also
    --------
    RunningCost, TransitionCost, TerminalConstraint

    Examples
    --------
    >>> far = sf.TerminalCost(lambda x, p: -x[0])
    >>> run = sf.Experiment(far, ("go",), (), 0.0, 1.0)
    >>> len(run.data)
    1
    """

    phi: Callable[..., Traced]

    def __post_init__(self) -> None:
        as_callable(self.phi, "TerminalCost", "a function phi(x, p)")


@dataclass(frozen=True, eq=False)
class TransitionCost:
    """Cost of a transition: adds ``mu(tau, x(tau-), p)`` to J at each transition between two modes.

    tau is the transition time, and x(tau-) the state just before it, before any reset map. Use it for the cost of a
    switch, a penalty on its distance from a desired state or time, or a prior that depends on the state.

    Parameters
    ----------
    mu : callable ``mu(t, x, p) -> scalar``, twice differentiable.
    before, after : str, optional
        The modes between which it counts; any mode if left out. No two may count at the same transition.

    See Also
    --------
    RunningCost, TerminalCost

    Examples
    --------
    Switching from "push" to "brake" costs the square of the speed:

    >>> cost = sf.TransitionCost(lambda t, x, p: x[1] ** 2, before="push", after="brake")
    """

    mu: Callable[..., Traced]
    before: str | None = None
    after: str | None = None

    def __post_init__(self) -> None:
        as_callable(self.mu, "TransitionCost", "a function mu(t, x, p)")
        for name in ("before", "after"):
            if getattr(self, name) is not None:
                as_name(getattr(self, name), name, "the name of a mode")


@dataclass(frozen=True, eq=False)
class TerminalConstraint:
    """Equality constraint on the final state: ``psi(x(tf), p) = 0``.

    Parameters
    ----------
    psi : callable ``psi(x, p) -> () or (m,)``, twice differentiable.

    See Also
    --------
    TerminalCost, HybridSystem

    Examples
    --------
    The speed has to be zero at the end:

    >>> at_rest = sf.TerminalConstraint(lambda x, p: x[1])
    >>> run = sf.Experiment([sf.TerminalCost(lambda x, p: -x[0]), at_rest], ("go",), (), 0.0, 1.0)
    >>> len(run.data)
    2
    """

    psi: Callable[..., Traced]

    def __post_init__(self) -> None:
        as_callable(self.psi, "TerminalConstraint", "a function psi(x, p)")
