"""Errors that callers distinguish, and `Issue`: a warning or a failure about a result, as data."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from switchfit.runtime.presentation import Printed


class InputError(ValueError):
    """An input is wrong; the message names the file and the key or line, the value given, and what to do."""


class NotIntegrableError(ValueError):
    """The model cannot be integrated at a theta: it is undefined, grows without bound or takes too many steps."""


class HiddenSwitchError(ValueError):
    """The cost changes with a parameter whose derivative is zero, as where a function switches by comparing with it."""


class MissingExtraError(InputError, ImportError):
    """A library that comes with one of switchfit's extras is not installed; the message has the command."""


def import_library(name: str, what: str, install: str, otherwise: str = "") -> Any:
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


def get_first_line(error: BaseException) -> str:
    """Return an exception in one line: its type and the first line of its message."""
    message = str(error).strip().splitlines()
    return f"{type(error).__name__}: {message[0]}" if message else type(error).__name__


@dataclass(frozen=True)
class Issue(Printed):
    """A warning, a failed check, or the reason why a fit ended; print it for the sentence.

    Attributes
    ----------
    kind : str
        Kind of the issue, such as "collapsed" or "integration error"; `switchfit.report.sentences` lists the kinds.
    subjects : tuple of str
        Names of the unknowns, channels or outputs that it concerns.
    figures : mapping of str to float or tuple of float
        Numbers in the sentence, by name; a tuple has one entry for each subject.

    See Also
    --------
    Certificate.failures, Termination.reason

    Examples
    --------
    >>> import switchfit as sf
    >>> issue = sf.Issue("error", ("the log is empty",))
    >>> issue.kind, issue.subjects
    ('error', ('the log is empty',))
    """

    kind: str
    subjects: tuple[str, ...] = ()
    figures: Mapping[str, float | tuple[float, ...]] = field(default_factory=dict)
