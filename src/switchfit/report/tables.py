"""Tables as data, and the one function that lays them out as text."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import NamedTuple

from switchfit.problem.data import FloatArray
from switchfit.problem.parameter import unit_suffix


class Table(NamedTuple):
    """Cells as text.

    Attributes
    ----------
    rows : sequence of sequences of str, of the same length each
        A header is a row like others.
    alignment : str
        A character for each column: "<" aligns it to the left, ">" to the right.
    """

    rows: Sequence[Sequence[str]]
    alignment: str

    @property
    def columns(self) -> list[int]:
        """Columns that have an entry in some row."""
        return [k for k in range(len(self.alignment)) if any(row[k] for row in self.rows)]


WIDTH = 100
"""Columns of a report, where names allow it."""

MOST_JUMPS = 6
"""Times of jumps that are listed; of more, the first ones and the last."""


def format_table(rows: Sequence[Sequence[str]], alignment: str, *, indent: str = "  ") -> list[str]:
    """Return rows as lines with their columns aligned, two spaces between them; columns without an entry are left out.

    Parameters
    ----------
    rows : sequence of sequences of str, of the same length each
        A header is a row like others.
    alignment : str
        A character for each column: "<" aligns it to the left, ">" to the right.
    indent : str, optional
        What every line begins with.
    """
    columns = [k for k in range(len(alignment)) if any(row[k] for row in rows)]
    widths = {k: max(len(row[k]) for row in rows) for k in columns}
    return [(indent + "  ".join(f"{row[k]:{alignment[k]}{widths[k]}}" for k in columns)).rstrip() for row in rows]


def wrap_text(text: str, first: str = "", others: str = "  ") -> list[str]:
    """Return text as lines of at most `WIDTH` columns.

    Parameters
    ----------
    text : str
    first, others : str, optional
        What the first line and the others begin with.
    """
    return textwrap.wrap(
        text, WIDTH, initial_indent=first, subsequent_indent=others, break_long_words=False, break_on_hyphens=False
    )


def list_jumps(times: FloatArray, time_unit: str) -> str:
    """Return how many jumps there are, and when; empty if there are none.

    Parameters
    ----------
    times : (K,) array
    time_unit : str
    """
    shown = [f"{time:.6g}" for time in times.tolist()]
    if len(shown) > MOST_JUMPS:
        shown = [*shown[: MOST_JUMPS - 2], "...", shown[-1]]
    count = "1 jump" if len(times) == 1 else f"{len(times)} jumps"
    return f"{count} at {', '.join(shown)}{unit_suffix(time_unit)}" if shown else ""
