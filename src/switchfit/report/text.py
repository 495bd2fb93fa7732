"""The report of a fit as plain text."""

from __future__ import annotations

from switchfit.result import Fit


def report(fit: Fit) -> str:
    """The report of a fit as plain text."""
    return fit.message
