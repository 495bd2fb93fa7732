"""Errors that readers of several formats raise: no column of times, a damaged file."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NoReturn

from switchfit.runtime.errors import InputError
from switchfit.runtime.files import explain_read_errors


def refuse_without_times(source: str, names: Iterable[str]) -> NoReturn:
    """Raise InputError for a table in which no column is found that has the times.

    Parameters
    ----------
    source : str
    names : iterable of str
    """
    from switchfit.problem.validation.messages import join_names  # here, since it imports NumPy

    raise InputError(
        f"{source}: no column is called time; its columns are {join_names(names)}. Name the one with the times: "
        "time = ..., or call it time in the file."
    )


@contextlib.contextmanager
def explain_damage(path: Path, what: str) -> Iterator[None]:
    """Return a context that turns any error of a library, which has many for damaged files, into an InputError.

    Parameters
    ----------
    path : Path
        Also checked to be there.
    what : str
        What it cannot be read as, with its article.
    """
    # A missing file is said to be missing; libraries say so in many ways, some of them that it is damaged.
    with explain_read_errors(path):
        path.stat()
    try:
        yield
    except InputError:
        raise
    # Any exception: on damaged bytes, readers raise KeyError, struct.error, RuntimeError and their own.
    except Exception as error:
        raise InputError(f"{path} cannot be read as {what}: {error or type(error).__name__}") from error
