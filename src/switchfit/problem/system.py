"""Hybrid systems: named modes, reset maps and guards between them, and an initial state."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

from switchfit.arrays import Converted, FloatArray, Traced
from switchfit.problem.parameter import Parameter, as_parameter
from switchfit.problem.validation.arrays import as_array
from switchfit.problem.validation.messages import shorten
from switchfit.problem.validation.names import as_labels, as_name, require_known
from switchfit.problem.validation.objects import as_callable, set_fields
from switchfit.runtime.presentation import format_line, join_first

VectorField = Callable[..., Traced]
"""``f(t, x, p) -> (n,)``, or ``f(t, x, p, u) -> (n,)`` in an experiment with inputs."""

ResetMap = Callable[..., Traced]
"""``R(t, x, p) -> (n,)``: the state just after a transition from the state just before it."""

Guard = Callable[..., Traced]
"""``g(t, x, p) -> ()``: zero where a transition happens, of the state just before it."""

AtTransitions = Mapping[tuple[str, str], Callable[..., Traced]]
"""Functions by the modes before and after a transition."""

InitialState = Callable[..., Traced] | FloatArray | tuple[Parameter, ...]
"""``x0(p) -> (n,)``, the state itself (n,), or n `Parameter` of which some are estimated."""


@dataclass(frozen=True, eq=False)
class HybridSystem:
    """A switched system: in mode ``i`` the state obeys ``dx/dt = f_i(t, x, p)``, equation (1).

    Parameters
    ----------
    modes : mapping of str to callable
        Vector field of each mode by name: ``f(t, x, p) -> (n,)`` written with ``jax.numpy``. ``t`` is a
        scalar in the experiment's time unit, ``x`` an ``(n,)`` array and ``p`` a dict of arrays; all are float64.
        In an experiment with inputs modes are called as ``f(t, x, p, u)``: ``u`` is a dict of scalars, an array or a
        scalar, as the values of the `switchfit.Input` were given.
    initial_state : (n,) array_like, or callable ``p -> (n,)``
        State at ``t0``; as a function of the parameters it is differentiated with them. An entry may be a
        `switchfit.Parameter`: it is then estimated, for each experiment by itself.
    reset_maps : mapping of (str, str) to callable, optional
        ``reset_maps[a, b]`` is applied at every transition from mode ``a`` to mode ``b``:
        ``x(tau+) = R(tau, x(tau-), p)``. Transitions without an entry leave the state continuous.
    state_names, state_units : sequence of str, optional
        One for each state; they label reports and plots.
    guards : mapping of (str, str) to callable, optional
        Every transition from mode ``a`` to mode ``b`` happens where ``guards[a, b](tau, x(tau-), p) = 0``: its time is
        then determined by the other unknowns. Transitions without an entry may happen at any time.

    Raises
    ------
    ValueError
        If a reset map or a guard names an unknown mode, or names, units and initial state differ in length.
    TypeError
        If a mode, a reset map or a guard is not callable, the initial state not made of numbers, or a name not a
        string.

    See Also
    --------
    Experiment, Problem, switchfit.models

    Examples
    --------
    A ball that falls until it reaches the ground, where it comes to rest:

    >>> system = sf.HybridSystem(
    ...     modes={
    ...         "fall": lambda t, x, p: jnp.array([x[1], -p["g"]]),
    ...         "rest": lambda t, x, p: jnp.zeros(2),
    ...     },
    ...     initial_state=[1.0, 0.0],
    ...     guards={("fall", "rest"): lambda t, x, p: x[0]},
    ...     state_names=("height", "speed"),
    ...     state_units=("m", "m/s"),
    ... )
    >>> list(system.modes)
    ['fall', 'rest']
    """

    modes: Mapping[str, VectorField]
    initial_state: Converted  # an `InitialState`
    reset_maps: Mapping[tuple[str, str], ResetMap] = field(default_factory=dict)
    state_names: Sequence[str] | None = None
    state_units: Sequence[str] | None = None
    guards: Mapping[tuple[str, str], Guard] = field(default_factory=dict)

    def __repr__(self) -> str:
        states = join_first(self.state_names or ())
        return format_line(self, f"modes {join_first(self.modes)}", f"states {states}" if states else "")

    def __post_init__(self) -> None:
        if not isinstance(self.modes, Mapping) or len(self.modes) == 0:
            raise ValueError(f"modes must be a non-empty dict of name -> vector field; got {shorten(self.modes)}.")
        for name, mode in self.modes.items():
            as_name(name, "mode names", "strings")
            as_callable(mode, f"mode {shorten(name)}", "a function f(t, x, p)")
        # Read-only copies: functions are traced once, so that a dict that the user changes later must not be the same.
        set_fields(self, modes=MappingProxyType(dict(self.modes)))
        for name in ("reset_maps", "guards"):
            set_fields(self, **{name: MappingProxyType(_check_pairs(getattr(self, name), name, self.modes))})
        set_fields(self, initial_state=as_state(self.initial_state))
        for label in ("state_names", "state_units"):
            set_fields(self, **{label: as_labels(getattr(self, label), label, "state")})
        # The number of states is known here only if they are given; of a function it is known once it is traced.
        if not callable(self.initial_state):
            self._check_labels_of(len(self.initial_state))

    def __reduce__(self) -> tuple[type, tuple[object, ...]]:
        """How it is copied and pickled: built again, from dicts, since a mappingproxy cannot be pickled."""
        return type(self), tuple(dict(v) if isinstance(v, Mapping) else v for v in vars(self).values())

    def _check_labels_of(self, n: int) -> None:
        """Raise ValueError unless names and units, if given, have one entry for each of n states."""
        for label in ("state_names", "state_units"):
            as_labels(getattr(self, label), label, "state", n)


def as_state(value: object) -> InitialState:
    """Return `value` as a finite, read-only ``(n,)`` float64 array, or as n `Parameter` if it contains any.

    A function is returned as it is.
    """
    if callable(value):
        return value
    if isinstance(value, (list, tuple)) and any(isinstance(entry, Parameter) for entry in value):
        form = "a number or an sf.Parameter"
        # Numbers beside a `Parameter` are fixed parameters: all entries are then of one kind.
        entries = tuple(as_parameter(entry, "each entry of initial_state", form, fixed=True) for entry in value)
        if any(entry.shape != () for entry in entries):
            shapes = shorten([entry.shape for entry in entries])
            raise ValueError(f"initial_state must have {form} of one number for each state; got the shapes {shapes}.")
        return entries
    state = as_array(value, "initial_state", form="an array of numbers, one for each state", finite=True)
    if state.ndim != 1 or state.size == 0:
        raise ValueError(f"initial_state must have shape (n,), one entry for each state; got shape {state.shape}.")
    state.flags.writeable = False
    return state


def _check_pairs(given: AtTransitions | None, name: str, modes: Mapping[str, VectorField]) -> AtTransitions:
    """Return functions of transitions, by the modes before and after."""
    checked = {} if given is None else given
    if not isinstance(checked, Mapping) or not all(isinstance(key, tuple) and len(key) == 2 for key in checked):
        raise TypeError(f"{name} must be a dict of (mode before, mode after) -> function; got {shorten(given)}.")
    for key, function in checked.items():
        require_known(key, name, modes)
        what, form = ("reset map", "R(t, x, p)") if name == "reset_maps" else ("guard", "g(t, x, p)")
        as_callable(function, f"{what} {shorten(key)}", f"a function {form}")
    return dict(checked)
