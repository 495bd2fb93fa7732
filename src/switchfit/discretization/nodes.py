"""Nodes: maps of the state, costs and constraints at one time.

start        ``x(t0) = x0(p)``
reset        ``x(tau_i+) = R(tau_i, x(tau_i-), p)``
sample       a cost of (t, x, p) at the end of a row; of a late sample at the end of a step of its own, which begins
             with the row that holds ``t - delay(p)`` and ends there
transition   costs of, and constraints on, ``(tau_i, x(tau_i-), p)``
end          costs of, and constraints on, ``(x(tf), p)``

Engines differentiate the functions listed here without distinguishing kinds by name. All functions take (t, x, p). For
a constraint, engines add ``weight . c`` to the cost, with the weights of a Lagrangian.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from switchfit.discretization.model import Model, Piece
from switchfit.problem.structure import Structure

NodeFunction = Callable[[Any, Any, Any], Any]


class TransitionKind(NamedTuple):
    """A kind of node at transitions.

    Attributes
    ----------
    name : str
        Field of `Structure` with its function for each transition, None for transitions without one.
    constraint : bool
        Whether its function has to be zero; else it is a cost.
    """

    name: str
    constraint: bool


AT_TRANSITIONS = (TransitionKind("guards", constraint=True), TransitionKind("transition_costs", constraint=False))
"""All kinds of nodes at transitions."""


def get_transition_function(
    model: Model, kind: TransitionKind, i: int, piece: Piece | None = None
) -> NodeFunction | None:
    """Return the scalar function of a kind at transition i (from 0); None if the transition has no such function.

    One that takes an input gets the one of a `piece`; by default, of the cell that ends at the transition or holds it.
    """
    function = getattr(model.structure, kind.name)[i]
    if function is None:
        return None
    if not function.takes_input:
        return lambda t, x, p: function(t, x, model.parameters(p))
    return lambda t, x, p: function(t, x, model.parameters(p), *model.inputs(t, piece or model.find_piece(t)))


def list_constrained_transitions(structure: Structure) -> list[tuple[TransitionKind, int]]:
    """Return the constraints at transitions in the order of their values: kind and transition."""
    kinds = [kind for kind in AT_TRANSITIONS if kind.constraint]
    return [(kind, i) for kind in kinds for i, f in enumerate(getattr(structure, kind.name)) if f is not None]


def list_costs_at_transitions(model: Model) -> list[tuple[int, NodeFunction]]:
    """Return the costs at transitions, each with its transition (from 0)."""
    return _at_transitions(model, constraint=False)


def list_constraints_at_transitions(model: Model) -> list[tuple[int, NodeFunction]]:
    """Return the constraints at transitions in the order of their values, each with its transition (from 0)."""
    return _at_transitions(model, constraint=True)


def _at_transitions(model: Model, constraint: bool) -> list[tuple[int, NodeFunction]]:
    kinds = [kind for kind in AT_TRANSITIONS if kind.constraint == constraint]
    found = [(i, get_transition_function(model, kind, i)) for kind in kinds for i in range(model.structure.N)]
    return [(i, function) for i, function in found if function is not None]


def get_end_cost(model: Model) -> NodeFunction | None:
    """Return the sum of the terminal costs; None without any."""
    return (lambda t, x, p: model.terminal(x, p)) if model.structure.terminal else None


def get_end_constraints(model: Model) -> NodeFunction | None:
    """Return all terminal constraints as one function, which returns (m,); None without any."""
    if not model.structure.terminal_constraints:
        return None
    return lambda t, x, p: model.terminal_constraint(x, p)
