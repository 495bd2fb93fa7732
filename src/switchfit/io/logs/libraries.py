"""Libraries that read or write a format, which are installed with an extra of switchfit."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from switchfit.runtime.errors import InputError
from switchfit.runtime.files import explain_read_errors


def import_library(name: str, extra: str, what: str, otherwise: str = "") -> Any:
    """Import a library.

    Parameters
    ----------
    name : str
        Such as ``"pyarrow.parquet"``.
    extra : str
        The extra of switchfit that it comes with.
    what : str
        What it is needed for, with the name of the file, as the begin of a sentence.
    otherwise : str, optional
        What else to do, as the end of a sentence.

    Raises
    ------
    InputError
        If it is not installed, with the command that installs it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        library = name.partition(".")[0]
        raise InputError(
            f"{what} needs {library}, which cannot be imported ({error}): pip install 'switchfit[{extra}]'"
            f"{', ' if otherwise else ''}{otherwise}."
        ) from error


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
    with explain_read_errors(path):
        path.stat()
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{path} cannot be read as {what}: {error or type(error).__name__}") from error
