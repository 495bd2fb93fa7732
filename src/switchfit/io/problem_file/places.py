"""Say in an error message where in a problem file it comes from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from switchfit.io.python_file import describe_error, find_user_place
from switchfit.runtime.errors import InputError


def build_at(where: str, build: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Return what a function builds; add the place in the problem file to its error messages.

    Parameters
    ----------
    where : str
        The place, such as "problem.toml: experiments[1].data[2]".
    build : callable
    arguments, named
        Of the function.

    Raises
    ------
    InputError
        For its ValueError or TypeError, and for any error in a Python file of the user.
    """
    try:
        return build(*arguments, **named)
    except (InputError, KeyboardInterrupt):
        raise
    except BaseException as error:
        if find_user_place(error) is not None:
            raise InputError(f"{where}: {describe_error(error)}.") from error
        if isinstance(error, (ValueError, TypeError)):
            raise InputError(f"{where}: {error}") from error
        raise
