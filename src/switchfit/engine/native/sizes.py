"""What a program depends on besides its library: the sizes of its arrays, and the order of its derivatives."""

from __future__ import annotations

from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from switchfit.discretization.arguments import Arguments
from switchfit.problem.structure import Structure

Shape = tuple[int, ...]


class Order(IntEnum):
    """What a program computes: J alone, with the gradient, and with the Hessian or the Gauss-Newton matrix too."""

    COST = 0
    GRADIENT = 1
    HESSIAN = 2
    GAUSS_NEWTON = 3


class Sizes(NamedTuple):
    """Sizes on which a program depends, in addition to the library.

    Attributes
    ----------
    n, N, M : numbers of states, of transitions at most, and of entries of p
    T : number of transition times with derivatives: all but those of jumps, which are known
    signals : number of channels of all signals
    m : number of terminal constraints
    constants : shapes of the fixed parameters, the weights of references and the initial state
    """

    n: int
    N: int
    T: int
    M: int
    signals: int
    m: int
    constants: tuple[Shape, ...]

    @classmethod
    def of(cls, structure: Structure, arguments: Arguments) -> Sizes:
        """Return the sizes of one experiment."""
        constants = tuple(np.shape(a) for a in constants_of(arguments))
        count = structure.terminal_constraint_count
        N = structure.transitions
        return cls(structure.n, N, N - structure.known, structure.M, arguments.signals.shape[2], count, constants)

    @property
    def D(self) -> int:
        """Number of unknowns: all transition times but those of jumps, then p."""
        return self.T + self.M

    @property
    def width(self) -> int:
        """Number of entries of a vector: even above 1, to suit the vector instructions of the CPU."""
        return self.D if self.D == 1 else self.D + self.D % 2


def constants_of(arguments: Arguments) -> list[Any]:
    """Return the arrays that functions of the model read in addition to t, x, p and signals."""
    return [*arguments.fixed, *arguments.weights, arguments.initial_state]
