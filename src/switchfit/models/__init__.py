"""Built-in models, by their names in problem files."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from switchfit.models.bicycle import bicycle
from switchfit.models.differential_drive import differential_drive
from switchfit.models.heater import heater_problem
from switchfit.models.lugre import lugre
from switchfit.models.magic_formula import magic_formula
from switchfit.models.rolling_body import rolling_body
from switchfit.models.skid_steer import skid_steer
from switchfit.models.sliding_block import sliding_block
from switchfit.problem.system import HybridSystem

#: Name in a problem file -> function that returns the system; its arguments are keyword-only.
BUILT_IN: Mapping[str, Callable[..., HybridSystem]] = MappingProxyType(
    {
        model.__name__: model
        for model in (skid_steer, sliding_block, magic_formula, differential_drive, bicycle, rolling_body, lugre)
    }
)

__all__ = [
    "BUILT_IN",
    "bicycle",
    "differential_drive",
    "heater_problem",
    "lugre",
    "magic_formula",
    "rolling_body",
    "skid_steer",
    "sliding_block",
]
