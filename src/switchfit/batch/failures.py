"""Errors of single fits, as one line of text each."""

from __future__ import annotations

import re

from switchfit.fit.termination import Termination
from switchfit.optimize import Status
from switchfit.runtime.issue import Issue

LONGEST_ERROR = 500
"""Characters of an error that are listed."""

EXCEPTION_LINE = re.compile(r"\s*[\w.]+(Error|Exception): ")
"""The line of a traceback that names an exception."""


def is_raised_in_callback(error: BaseException) -> bool:
    """Return whether a function that a program calls in Python raised it: JAX raises a ValueError or a JaxRuntimeError
    of its own, with the traceback in its text.
    """
    return "error calling callback" in str(error)


def describe_failure(error: BaseException) -> str:
    """Return the message of a fit that ended with an error, on one line."""
    return str(Termination(Status.ERROR, reason=Issue("error", (describe_error(error),))))


def describe_error(error: BaseException) -> str:
    """Return kind and text of an error on one line; of an error in a callback, those of the original error."""
    # JAX hands on what a callback raised as text, whose last such line says what it was.
    raised = [line for line in str(error).splitlines() if EXCEPTION_LINE.match(line)]
    text = raised[-1] if raised else f"{type(error).__name__}: {error}"
    return " ".join(text.split())[:LONGEST_ERROR]
