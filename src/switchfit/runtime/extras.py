"""Libraries of switchfit's extras, which are imported where they are needed and may be missing."""

from __future__ import annotations

import importlib
from types import ModuleType

from switchfit.runtime.errors import InputError


class MissingExtraError(InputError, ImportError):
    """A library that comes with one of switchfit's extras is not installed; the message has the command."""


def import_library(name: str, what: str, install: str, otherwise: str = "") -> ModuleType:
    """Return a library that is imported where it is needed.

    Parameters
    ----------
    name : str
        Such as ``"pyarrow.parquet"``.
    what : str
        What it is needed for, as the begin of a sentence.
    install : str
        What pip installs.
    otherwise : str, optional
        What else to do, as the end of a sentence.

    Raises
    ------
    MissingExtraError
        If it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        library = name.partition(".")[0]
        raise MissingExtraError(
            f"{what} needs {library}, which cannot be imported ({error}): pip install {install}{otherwise}."
        ) from error
