"""What evaluates a cost and its derivatives: machine code of its own, or JAX, and why."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Engine:
    """What evaluated a cost and its derivatives.

    Attributes
    ----------
    name : str
        "native" for machine code, or "jax".
    reason : str or None
        Why JAX does it: what in the problem has no machine code. A reason that begins with "internal: " is a defect of
        switchfit, not of the model. None for machine code.
    """

    name: str
    reason: str | None = None

    @classmethod
    def of(cls, reason: str | None) -> Engine:
        """Machine code, unless there is a reason against it."""
        return cls("native") if reason is None else cls("jax", reason)

    def __str__(self) -> str:
        return "Evaluated in machine code." if self.reason is None else f"Evaluated by JAX: {self.reason}."
