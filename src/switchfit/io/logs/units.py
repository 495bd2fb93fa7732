"""Units in the names and cells of logs: what is one, and how to split it from a name."""

from __future__ import annotations

import re

from switchfit.problem.time_units import TIME_UNITS

_PREFIXED = (
    "m", "s", "g", "rad", "Hz", "N", "Nm", "Pa", "V", "A", "W", "J", "K", "T", "G", "F", "H", "C", "Ohm", "Ω", "bar",
    "l", "L", "px",
)  # fmt: skip

_PLAIN = (
    "1", "-", "%", "°", "deg", "degree", "degrees", "grad", "rad", "°C", "degC", "°F", "°/s", "min", "h", "d", "rpm",
    "ticks", "tick", "counts", "count", "pix", "pixel", "pixels", "ft", "in", "mi", "kn", "kt", "kts", "knots", "mph",
    "kph", "psi", "rev", "bit", "bool", "fps", "sec", "msec", "usec", "nsec", "mol", "lx", "dB", "mps", "kmh",
)  # fmt: skip

# Longest first: of the alternatives of a regular expression the first that matches is taken, and m is not min.
_FACTOR = re.compile(
    rf"(?:{'|'.join(re.escape(u) for u in sorted(_PLAIN, key=len, reverse=True))}"
    rf"|[nuµμmckMG]?(?:{'|'.join(re.escape(u) for u in sorted(_PREFIXED, key=len, reverse=True))}))"
    r"(?:\^?-?\d|\*\*-?\d|[²³⁻¹]+)?"
)

# Few, and after a letter that is no underscore: `x_m` is in metres, but `a_s` or `index_d` may be anything.
_SUFFIX = re.compile(r"[^_]_(ns|us|ms|s|sec|min|rad|deg|m|mm|cm|km|Hz|rpm|mps|Nm)$")


def is_unit(text: str) -> bool:
    """Return whether a text is a unit, such as ``m/s^2``, ``°C``, ``ticks`` or ``[rad/s]``."""
    inner = strip_brackets(text)
    if not inner:
        return False
    factors = re.split(r"[/*·. ]", inner)
    return all(_FACTOR.fullmatch(factor) for factor in factors)


def strip_brackets(text: str) -> str:
    """Return a text without the brackets around it."""
    text = text.strip()
    return text[1:-1].strip() if text[:1] + text[-1:] in ("[]", "()", "{}", "<>") else text


def split_unit(name: str) -> tuple[str, str]:
    """Return the name and the unit in a text such as ``"x [m]"``, ``"x (m)"`` or ``"x_m"``.

    A suffix stays in the name; the unit is empty where there is none.
    """
    match = re.fullmatch(r"(.*\S)\s*(\[[^\[\]]{1,12}\]|\([^()]{1,12}\))", name)
    # Square brackets hold units whatever they say; round ones also remarks, as in `speed (left)`.
    if match and (is_unit(match[2]) or match[2][0] == "["):
        return match[1], strip_brackets(match[2])
    suffix = _SUFFIX.search(name)
    return name, suffix[1] if suffix else ""


def normalize_time_unit(text: str) -> str:
    """Return the key of `SECONDS_OF_UNIT` that a text stands for, or the text itself if it is no unit of time."""
    return TIME_UNITS.get(strip_brackets(text).lower(), text)
