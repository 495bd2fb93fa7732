"""Libraries that read or write a format, which are installed with an extra of switchfit."""

from __future__ import annotations

import importlib
from typing import Any

from switchfit.runtime.errors import InputError


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
