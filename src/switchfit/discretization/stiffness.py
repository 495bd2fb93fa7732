"""Why a mode of an experiment takes implicit steps: the record that a mesh carries and users read."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Stiffness:
    """Why ``solver="auto"`` takes implicit steps in a mode of an experiment; print it for a sentence.

    Attributes
    ----------
    mode : str
    explicit_steps, implicit_steps : int
        Steps that either method needs in it, to the same tolerance.
    stability : float
        ``|lambda| h`` of the explicit steps, lambda being the largest eigenvalue of the Jacobian whose component
        decays. An explicit method is unstable above about 3.3.

    See Also
    --------
    Problem : takes `solver`.
    Evaluation, evaluate

    Examples
    --------
    >>> fast = sf.HybridSystem({"relax": lambda t, x, p: -p["rate"] * (x - jnp.cos(t))}, [0.0])
    >>> run = sf.Experiment(sf.RunningCost(lambda t, x, p: x[0] ** 2), ("relax",), (), 0.0, 10.0)
    >>> problem = sf.Problem(fast, run, {"rate": 1e5})
    >>> found = sf.evaluate(problem).stiffness[0]
    >>> found.mode, found.implicit_steps < found.explicit_steps / 100
    ('relax', True)
    """

    mode: str
    explicit_steps: int
    implicit_steps: int
    stability: float

    def __str__(self) -> str:
        return (
            f"mode {self.mode!r} is stiff: it takes {self.explicit_steps:,} explicit steps (limited by stability: "
            f"|lambda| h is about {self.stability:.2g}) or {self.implicit_steps:,} implicit ones; implicit ones were "
            "chosen for this mode"
        )
