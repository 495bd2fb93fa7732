"""The switched models of the comparison with other libraries, in a form that every one of them can take.

Right-hand sides are written once, entry by entry, with the functions of whatever module they are given: `math` for
SciPy, `casadi`, `heyoka`. Nothing here imports switchfit or JAX, so that a cold process of another library does not pay
for them. The same models as switchfit takes them: `problems.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

Field = Callable[[str, Sequence[Any], Sequence[Any], Any], list[Any]]


@dataclass(frozen=True, eq=False)
class Model:
    """A switched model, autonomous in every mode, with the cost ``J = integral of density(x) dt``.

    Attributes
    ----------
    field : ``field(mode, x, p, functions) -> list``; `functions` has sin and cos
    density : ``density(x) -> number``
    sequence, times, horizon : modes in turn, first guess of the N switches, (t0, tf)
    x0, p : initial state (n,), first guess of the parameters (M,)
    stiff : whether an explicit method is hopeless
    optimum : J at the best known optimum, NaN if not known
    """

    name: str
    field: Field
    density: Callable[[Sequence[Any]], Any]
    sequence: tuple[str, ...]
    times: tuple[float, ...]
    horizon: tuple[float, float]
    x0: tuple[float, ...]
    p: tuple[float, ...] = ()
    stiff: bool = False
    optimum: float = float("nan")

    @property
    def theta(self) -> np.ndarray:
        """First guess of all unknowns, switches first: (N + M,)."""
        return np.array([*self.times, *self.p])

    @property
    def modes(self) -> tuple[str, ...]:
        """The modes, each once."""
        return tuple(dict.fromkeys(self.sequence))

    def segments(self, theta: Sequence[Any]) -> list[tuple[str, Any, Any]]:
        """Each mode in turn with its start and end."""
        ends = [self.horizon[0], *[theta[i] for i in range(len(self.times))], self.horizon[1]]
        return [(mode, a, b) for mode, (a, b) in zip(self.sequence, pairwise(ends), strict=True)]

    def parameters(self, theta: Sequence[Any]) -> list[Any]:
        """The parameters in theta."""
        return [theta[i] for i in range(len(self.times), len(self.times) + len(self.p))]


# --- the paper's vehicle, equation (18), cost 1/2 |x|^2 ---------------------------------------------------------------


def _vehicle(mode: str, x: Sequence[Any], p: Sequence[Any], functions: Any) -> list[Any]:
    _, dX, _, dY, angle, turn = x
    cos, sin = functions.cos(angle), functions.sin(angle)
    if mode == "stick":
        return [dX, (60.0 * cos - 0.72 * dX) / 80.0, dY, (60.0 * sin - 0.72 * dY) / 80.0, turn, 0.0 * turn]
    (mu,) = p
    v = cos * dY - sin * dX
    inertia = 10.0 * (12 * 0.25**2 + 12 * 0.23**2) + 70.0 * (0.89**2 + 0.55**2)
    ddX = (54.0 * cos - 0.92 * dX) / 80.0 + 9.81 * mu * sin * v
    ddY = (54.0 * sin - 0.92 * dY) / 80.0 - 9.81 * mu * cos * v
    return [dX, ddX, dY, ddY, turn, (12 * 0.23 * 54.0 - 12 * 0.25**2 * 9.81 * 80.0 * mu * turn) / inertia]


def _half_square(x: Sequence[Any]) -> Any:
    return 0.5 * sum(x[i] * x[i] for i in range(len(x)))


VEHICLE = Model(
    "vehicle", _vehicle, _half_square, ("stick", "slip", "stick"), (5.0, 9.0), (0.0, 15.0), (0.0,) * 6, (0.8,)
)

# --- Lotka-Volterra fishing: when is the fleet out? -------------------------------------------------------------------


def _fishing(mode: str, x: Sequence[Any], p: Sequence[Any], functions: Any) -> list[Any]:
    u = 1.0 if mode == "fishing" else 0.0
    prey, predator = x
    return [prey - prey * predator - 0.4 * u * prey, prey * predator - predator - 0.2 * u * predator]


def _off_balance(x: Sequence[Any]) -> Any:
    return (x[0] - 1.0) * (x[0] - 1.0) + (x[1] - 1.0) * (x[1] - 1.0)


FISHING = Model(
    "fishing",
    _fishing,
    _off_balance,
    ("idle", "fishing") * 4 + ("idle",),
    tuple(12.0 * (i + 1) / 9 for i in range(8)),
    (0.0, 12.0),
    (0.5, 0.7),
    optimum=1.345295218283,
)
FISHING_START = (
    2.4434718158,
    4.1225525221,
    4.4330728450,
    4.6825200233,
    5.2016678278,
    5.3699088950,
    6.3768451909,
    6.4716034021,
)
"""The optimum that SwitchTimeOpt.jl publishes, off by up to 0.02."""
FISHING_BEST = (
    2.4420392297,
    4.1168721058,
    4.4197702383,
    4.6699644285,
    5.1828371488,
    5.3537063284,
    6.3557436884,
    6.4527645889,
)
"""The optimal switches, found by integration to 1e-12."""

# --- a chain of ten masses, pushed at its end or not ------------------------------------------------------------------

MASSES = 10


def _chain(mode: str, x: Sequence[Any], p: Sequence[Any], functions: Any) -> list[Any]:
    q, v = [x[i] for i in range(MASSES)], [x[MASSES + i] for i in range(MASSES)]
    pull = [p[i] * ((q[i - 1] - q[i]) if i else -q[0]) for i in range(MASSES)]  # of spring i on mass i
    push = 1.0 if mode == "pushed" else 0.0
    forces = [pull[i] - pull[i + 1] - 0.1 * v[i] for i in range(MASSES - 1)]
    return [*v, *forces, pull[-1] - 0.1 * v[-1] + push]


CHAIN = Model(
    "chain",
    _chain,
    _half_square,
    ("pushed", "free") * 5 + ("pushed",),
    tuple(10.0 * (i + 1) / 11 + 1e-3 for i in range(10)),
    (0.0, 10.0),
    (0.0,) * (2 * MASSES),
    tuple(1.0 + 0.1 * i for i in range(MASSES)),
)

# --- Van der Pol's oscillator with mu = 1000, then a slow decay -------------------------------------------------------


def _stiff(mode: str, x: Sequence[Any], p: Sequence[Any], functions: Any) -> list[Any]:
    mu, k = p
    if mode == "oscillator":
        return [x[1], mu * (1.0 - x[0] * x[0]) * x[1] - x[0]]
    return [-k * x[0], -k * x[1]]


STIFF = Model(
    "stiff",
    _stiff,
    lambda x: x[0] * x[0],
    ("oscillator", "decay"),
    (300.0,),
    (0.0, 400.0),
    (2.0, 0.0),
    (1000.0, 0.02),
    stiff=True,
)

# --- stiff modes beside others: Robertson, HIRES, a heater with a fast sensor, friction at 1e-6 m/s -------------------


def _robertson(mode: str, x: Sequence[Any], p: Sequence[Any], functions: Any) -> list[Any]:
    a, b, c = p
    slow, fast = a * x[0], c * x[1] * x[1]
    back = b * x[1] * x[2] if mode == "stirred" else 0.1 * b * x[1] * x[2]
    return [back - slow, slow - back - fast, fast]


ROBERTSON = Model(
    "robertson",
    _robertson,
    lambda x: x[0] * x[0],
    ("stirred", "still"),
    (20.0,),
    (0.0, 100.0),
    (1.0, 0.0, 0.0),
    (0.04, 1e4, 3e7),
    stiff=True,
)


def _hires(mode: str, x: Sequence[Any], p: Sequence[Any], functions: Any) -> list[Any]:
    rate, light = p[0], p[1] if mode == "light" else 0.1 * p[1]
    meet = rate * x[5] * x[7]
    return [
        -light * x[0] + 0.43 * x[1] + 8.32 * x[2] + 0.0007,
        light * x[0] - 8.75 * x[1],
        -10.03 * x[2] + 0.43 * x[3] + 0.035 * x[4],
        8.32 * x[1] + 1.71 * x[2] - 1.12 * x[3],
        -1.745 * x[4] + 0.43 * x[5] + 0.43 * x[6],
        -meet + 0.69 * x[3] + 1.71 * x[4] - 0.43 * x[5] + 0.69 * x[6],
        meet - 1.81 * x[6],
        1.81 * x[6] - meet,
    ]


HIRES = Model(
    "hires",
    _hires,
    lambda x: x[0] * x[0],
    ("light", "dark"),
    (100.0,),
    (0.0, 321.8122),
    (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0057),
    (280.0, 1.71),
    stiff=True,
)


def _heater(mode: str, x: Sequence[Any], p: Sequence[Any], functions: Any) -> list[Any]:
    power, loss, rate = p
    heat = power if mode == "on" else 0.0
    return [heat - loss * x[0], 0.2 * (x[0] - x[1]), rate * (x[1] - x[2])]


HEATER = Model(
    "heater",
    _heater,
    lambda x: (x[2] - 1.0) * (x[2] - 1.0),
    ("on", "off"),
    (30.0,),
    (0.0, 100.0),
    (0.0, 0.0, 0.0),
    (0.2, 0.1, 2000.0),
    stiff=True,
)


def _friction(mode: str, x: Sequence[Any], p: Sequence[Any], functions: Any) -> list[Any]:
    mu, push = p
    force = push if mode == "push" else 0.0
    return [x[1], force - mu * 9.81 * x[1] / functions.sqrt(x[1] * x[1] + 1e-12)]


FRICTION = Model(
    "friction",
    _friction,
    lambda x: x[0] * x[0],
    ("push", "slide"),
    (0.5,),
    (0.0, 3.0),
    (0.0, 1e-6),
    (0.3, 6.0),
    stiff=True,
)

MODELS = {model.name: model for model in (VEHICLE, FISHING, CHAIN, STIFF, ROBERTSON, HIRES, HEATER, FRICTION)}


def integrate_sample(rates: Callable[[Any], Any], z: Any, period: float) -> Any:
    """Return z (n,) a sample interval later, by two steps of the classical Runge-Kutta method, in any array library."""
    h = period / 2
    for _ in range(2):
        k1 = rates(z)
        k2 = rates(z + h / 2 * k1)
        k3 = rates(z + h / 2 * k2)
        k4 = rates(z + h * k3)
        z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return z
