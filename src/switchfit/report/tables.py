"""Tables as data, and the one function that lays them out as text."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import NamedTuple

from switchfit.problem.data import FloatArray
from switchfit.problem.parameter import unit_suffix
from switchfit.report.dates import Timed, format_time


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
    columns = Table(rows, alignment).columns
    widths = {k: max(len(row[k]) for row in rows) for k in columns}
    return [(indent + "  ".join(f"{row[k]:{alignment[k]}{widths[k]}}" for k in columns)).rstrip() for row in rows]


def name_columns(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return a header without the titles of columns that have no entry, so that these are left out.

    Parameters
    ----------
    titles : sequence of str
    rows : sequence of sequences of str
    """
    return [title if any(row[k] for row in rows) else "" for k, title in enumerate(titles)]


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


def list_jumps(times: FloatArray, run: Timed) -> str:
    """Return how many jumps there are, and when; empty if there are none.

    Parameters
    ----------
    times : (K,) array
    run : Timed
        Of which they are: dates if its times are dates.
    """
    shown = [format_time(time, run) for time in times.tolist()]
    if len(shown) > MOST_JUMPS:
        shown = [*shown[: MOST_JUMPS - 2], "...", shown[-1]]
    count = "1 jump" if len(times) == 1 else f"{len(times)} jumps"
    unit = "" if run.origin is not None else unit_suffix(run.time_unit)
    return f"{count} at {', '.join(shown)}{unit}" if shown else ""
