"""Fits as JSON files."""

from __future__ import annotations

from pathlib import Path

from switchfit.result import Certificate, Fit


def save_fit(fit: Fit, certificate: Certificate, path: Path) -> None:
    """Write a fit."""
    raise NotImplementedError


def load_fit(path: Path) -> tuple[Fit, Certificate]:
    """Read a fit."""
    raise NotImplementedError
