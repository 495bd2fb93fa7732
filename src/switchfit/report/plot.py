"""Figures of a fit."""

from __future__ import annotations

from typing import Any

from switchfit.result import Fit


def plot_fit(fit: Fit) -> Any:
    """Measured against fitted over time."""
    raise NotImplementedError
