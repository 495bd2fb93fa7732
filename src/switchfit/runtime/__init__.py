"""Services that do not depend on the problem: files, caches, XLA's flags, progress. Imports no other room.

A later room that registers functions here (`presentation`) is imported when one of them is first asked for. How, the
package on top of the house hands down, which `import switchfit` runs before anything: nothing is imported for it.
"""

from __future__ import annotations

TYPE_CHECKING = False  # type checkers know the name; to import it from typing takes as long as all of switchfit
if TYPE_CHECKING:
    from collections.abc import Callable

_loaders: list[Callable[[], object]] = []


def load_later(load: Callable[[], object]) -> None:
    """Have a room imported, by a function without arguments, when a result is first printed or drawn."""
    _loaders.append(load)


def load_registering_rooms() -> None:
    """Import the rooms that register functions for results."""
    for load in _loaders:
        load()
