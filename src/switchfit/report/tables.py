"""Tables as data, and their layout as text at most 100 columns wide where names allow it."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Sequence
from typing import NamedTuple

Row = Sequence[str]
Rows = Sequence[Row]

WIDTH = 100
"""Columns of a report, where names allow it."""


class Table(NamedTuple):
    """Cells as text.

    Attributes
    ----------
    rows : sequence of sequences of str, of the same length each
    alignment : str
        A character for each column: "<" aligns it to the left, ">" to the right.
    titles : sequence of str
        Of the columns; empty for a table without a header.
    """

    rows: Rows
    alignment: str
    titles: Row = ()

    @property
    def columns(self) -> list[int]:
        """Columns that have an entry in some row; the others are left out."""
        return [k for k in range(len(self.alignment)) if any(row[k] for row in self.rows)]


def format_table(
    rows: Rows, alignment: str, titles: Row = (), *, indent: str = "  ", most: int = sys.maxsize, where: str = ""
) -> list[str]:
    """Return the lines of a table with its columns aligned, two spaces between them.

    Parameters
    ----------
    rows, alignment, titles
        As of `Table`.
    indent : str, optional
        What every line begins with.
    most : int, optional
        Of more rows the first are listed, and the others counted.
    where : str, optional
        Where the others are, behind their number.
    """
    # Widths are those of the rows that are shown; a column without any entry takes no room.
    shown = rows[:most]
    columns, written = Table(shown, alignment).columns, [titles, *shown] if titles and rows else shown
    widths = {k: max(len(row[k]) for row in written) for k in columns}
    lines = [(indent + "  ".join(f"{row[k]:{alignment[k]}{widths[k]}}" for k in columns)).rstrip() for row in written]
    return lines + ([f"{indent}and {len(rows) - most} more{where}"] if len(rows) > most else [])


def join_sections(*sections: Sequence[str]) -> str:
    """Return sections as text, with an empty line between them; those without a line are left out.

    Parameters
    ----------
    sections : sequence of str
        The lines of each.
    """
    return "\n\n".join("\n".join(lines) for lines in sections if lines)


def wrap_text(text: str, first: str = "", others: str = "  ", width: int = WIDTH) -> list[str]:
    """Return text as lines of at most so many columns, where names allow it.

    Parameters
    ----------
    text : str
    first, others : str, optional
        What the first line and the others begin with.
    width : int, optional
    """
    return textwrap.wrap(
        text, width, initial_indent=first, subsequent_indent=others, break_long_words=False, break_on_hyphens=False
    )
