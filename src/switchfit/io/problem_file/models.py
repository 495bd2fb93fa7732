"""Load what a problem file names in Python: the model, observations, jumps."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from switchfit.io.problem_file.tables import DataTable, JumpTable, ModelTable
from switchfit.io.python_file import call, find_object, load_object
from switchfit.models import BUILT_IN
from switchfit.problem.jump import Jump
from switchfit.problem.system import HybridSystem
from switchfit.runtime.errors import InputError


def build_system(path: Path, table: ModelTable) -> HybridSystem:
    """Return the system of a model that is built in, or in a Python file.

    Parameters
    ----------
    path : Path
        The problem file.
    table : ModelTable
    """
    what = f"{path}: model"
    if table.name in BUILT_IN:
        found = BUILT_IN[table.name]
    else:
        check_model_name(what, table)
        found = load_object(table.name, path.parent, what)
    if callable(found):
        found = call(found, f"{what} {table.name!r}", **_check_arguments(found, table, what))
    elif table.arguments:
        raise InputError(f"{what} {table.name!r} is not a function; leave out its arguments.")
    if not isinstance(found, HybridSystem):
        raise InputError(
            f"{what} {table.name!r} must be an sf.HybridSystem or a function that returns one; "
            f"got {type(found).__name__}."
        )
    return found


def check_model_name(what: str, table: ModelTable) -> None:
    """Raise InputError unless a model that is not built in is named as an object of a Python file.

    Parameters
    ----------
    what : str
        Place in the problem file, for messages.
    table : ModelTable
    """
    if ".py" not in table.name:
        raise InputError(
            f"{what} {table.name!r} is not known; the built-in models are {', '.join(BUILT_IN)}. Give a model of your "
            "own as 'file.py:object'."
        )


def _check_arguments(factory: Callable[..., Any], table: ModelTable, what: str) -> dict[str, Any]:
    """Return the arguments of a table; raise if the factory does not take them."""
    try:
        inspect.signature(factory).bind(**table.arguments)
    except TypeError as error:
        takes = ", ".join(inspect.signature(factory).parameters) or "no arguments"
        raise InputError(f"{what} {table.name!r}: {error}; it takes {takes}.") from error
    return table.arguments


def build_jump(folder: Path, table: JumpTable, system: HybridSystem | None, where: str) -> Jump:
    """Return a jump; without a system, one whose map was not loaded.

    Parameters
    ----------
    folder : Path
        Of the problem file.
    table : JumpTable
    system : HybridSystem or None
    where : str
        Place in the problem file, for messages.
    """
    if ".py" not in table.map.name:
        raise ValueError(f"map must name a function of a Python file, 'file.py:function'; got {table.map.name!r}.")
    if system is None:
        find_object(table.map.name, folder, where)
        return Jump(table.time, lambda t, x, p: x)
    found = load_object(table.map.name, folder, where)
    if table.map.arguments and callable(found):
        found = call(found, f"{where} {table.map.name!r}", **_check_arguments(found, table.map, where))
    return Jump(table.time, found)


def build_observe(folder: Path, table: DataTable, system: HybridSystem | None, where: str) -> Callable[..., Any] | None:
    """Return the observation h(t, x, p); None for the whole state, or without a system.

    Parameters
    ----------
    folder : Path
        Of the problem file.
    table : DataTable
    system : HybridSystem or None
    where : str
        Place in the problem file, for messages.
    """
    if table.observe is None:
        return None
    if isinstance(table.observe, str):
        if system is None:
            find_object(table.observe, folder, f"{where}.observe")
            return None
        observe = load_object(table.observe, folder, f"{where}.observe")
        if not callable(observe):
            raise ValueError(f"observe {table.observe!r} must be a function h(t, x, p); got {type(observe).__name__}.")
        return observe
    if len(table.observe) != len(table.columns):
        raise ValueError(
            f"observe must name one state for each of the {len(table.columns)} columns; got {table.observe}."
        )
    if system is None:
        return None
    if system.state_names is None:
        raise ValueError("observe names states, but the model has no state_names; add them to it.")
    unknown = [name for name in table.observe if name not in system.state_names]
    if unknown:
        raise ValueError(
            f"observe names the unknown state {unknown[0]!r}; the states are {', '.join(system.state_names)}."
        )
    return select_states(tuple(system.state_names.index(name) for name in table.observe))


@functools.cache
def select_states(indices: tuple[int, ...]) -> Callable[..., Any]:
    """Return the observation ``h(t, x, p) = x[indices]``, cached by indices so that it compiles once.

    Parameters
    ----------
    indices : tuple of int
        Positions in the state.
    """
    picked = np.array(indices)

    def observe(t: Any, x: Any, p: Any) -> Any:
        return x[picked]

    return observe
