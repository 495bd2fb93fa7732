"""What tests do to printed texts before they compare them."""

from __future__ import annotations

import re


def without_wall_time(text: str) -> str:
    """Seconds of the clock on the wall left out: they are never the same, and seconds whatever the unit of the log."""
    text = re.sub(r"(evaluations?),\s+[\d.e+-]+\s+s\b", r"\1", text)
    text = re.sub(r"(J\s+=\s+[\d.e+-]+)\s+\([\d.e+-]+\s+s\)", r"\1", text)
    return re.sub(r"fits in [\d.]+ s \([\d.]+ ms each\)", "fits", text)
