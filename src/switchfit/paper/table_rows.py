"""Lines of the table that compares the paper's numbers with ours, from templates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

Found = dict[str, Any]
Say = Callable[[str], None]


class TableRow(NamedTuple):
    """One line of the table of results."""

    claim: str
    paper: str
    ours: str
    remark: str = ""


def fill_rows(text: str, **values: object) -> list[TableRow]:
    """Return the lines of a template: each begins with "* ", and "|" is between its cells; values stand by their names.

    Parameters
    ----------
    text : str
    **values : object
        What stands in braces, as of `str.format`: ``{fit[theta][mu]:.3f}``.
    """
    lines = text.strip().removeprefix("* ").split("\n* ")
    return [TableRow(*(" ".join(cell.split()).format_map(values) for cell in line.split("|"))) for line in lines]
