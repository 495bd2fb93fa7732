"""The head of a table of text: its delimiter, the lines of names and units, and where the data begin."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Sequence

from switchfit.io.logs.cells import is_data, is_missing
from switchfit.io.logs.units import is_unit, split_unit, strip_brackets

DELIMITERS = (";", "\t", ",", "|", " ")
"""What may separate fields; of two that split all lines alike, the first one: commas are decimals then."""

NumberedLine = tuple[int, str]
"""Number of a line, and its text."""

NumberedRow = tuple[int, list[str]]
"""Number of a line, and its cells."""


def find_delimiter(lines: Sequence[NumberedLine]) -> str:
    """Return the delimiter that splits most of the lines into the same number of fields, more than one."""

    def share(delimiter: str) -> float:
        try:
            counts = Counter(len(cells) for _, cells in split_lines(lines, delimiter))
        except ValueError:
            return 0.0
        fields, often = counts.most_common(1)[0]
        return often / len(lines) if fields > 1 else 0.0

    return max(DELIMITERS, key=share) if any(map(share, DELIMITERS)) else ","


def split_lines(lines: Sequence[NumberedLine], delimiter: str) -> list[NumberedRow]:
    """Return the number and the cells of each line; of lines that quotes join, the number of the last one."""
    texts = [text.strip() if delimiter == " " else text for _, text in lines]
    # Spaces behind a delimiter are dropped by the reader, those before it here: a loop over all cells, only if needed.
    reader = csv.reader(texts, delimiter=delimiter, skipinitialspace=True)
    try:
        rows = [(lines[reader.line_num - 1][0], cells) for cells in reader]
        if any(" " in text or "\t" in text for text in texts):
            rows = [(line, [cell.rstrip() for cell in cells]) for line, cells in rows]
        return rows
    except csv.Error as error:
        line = lines[min(reader.line_num, len(lines)) - 1][0]
        raise ValueError(f"line {line}: {error}; is a quotation mark missing?") from error


def read_header(rows: Sequence[list[str]], comment: list[str]) -> tuple[list[str], list[str], dict[str, int], int]:
    """Return the names of the columns, their units, the column of each name in the header, and the first row of data.

    Parameters
    ----------
    rows : sequence of list of str
        The cells of the first lines.
    comment : list of str
        Cells of the last line of comments before them: the names, if no row has any and the number is right.
    """
    begin = _skip_preamble(rows)
    # Lines of names and units follow one another; the first line that begins with a number ends them.
    first = begin
    while first < len(rows) and _is_header(rows[first], first == begin):
        first += 1
    width = len(rows[begin])
    lines = [_strip_end(cells) for cells in rows[begin:first]] or [comment if len(comment) == width else [""] * width]
    return *_assign_lines(lines), first


def _skip_preamble(rows: Sequence[list[str]]) -> int:
    """Return the index of the first row that has as many fields as most, if it is text; 0 otherwise."""
    # Lines before the header, as loggers write them ("Device: ...", "Rate: 100 Hz"), have fewer fields than the data.
    # The header is the first line as wide as the widest of the common ones; empty fields at the end do not count.
    common = Counter(map(len, rows)).most_common(1)[0][0]
    widths = [len(_strip_end(cells)) for cells in rows]
    width = max(own for own, cells in zip(widths, rows, strict=True) if len(cells) == common)
    k = widths.index(width)
    return k if _is_header(rows[k], True) else 0


def _is_header(cells: list[str], first: bool) -> bool:
    """Return whether cells are names or units; numbers may be names in the first line, but not in its first field."""
    has_text = any(not is_missing(cell) and not is_data(cell) for cell in cells)
    return has_text and not any(map(is_data, cells[:1] if first else cells))


def _strip_end(cells: list[str]) -> list[str]:
    """Return cells without the empty ones at the end."""
    filled = [k for k, cell in enumerate(cells, start=1) if cell]
    return cells[: max(filled, default=0)]


def _assign_lines(lines: list[list[str]]) -> tuple[list[str], list[str], dict[str, int]]:
    """Tell names from units among the lines of a header."""
    width = max(map(len, lines))
    lines = [[*line, *[""] * (width - len(line))] for line in lines]
    # A single line is always the names, though m and s may be names, too.
    unit_lines = [line for line in lines if _is_unit_line(line)] if len(lines) > 1 else []
    name_lines = [line for line in lines if line not in unit_lines] or unit_lines[:1]
    unique = [line for line in name_lines if len(set(line)) == width]
    if unique:
        # Of a line of titles and one of short names, both unique, the short ones: they can be written in Python.
        chosen = max(unique, key=lambda line: sum(cell.isidentifier() for cell in line))
    elif len(name_lines) > 1:  # groups above names, each in a line
        chosen = [".".join(filter(None, cells)) for cells in zip(*name_lines, strict=True)]
    else:
        chosen = name_lines[0]
    names, units = map(list, zip(*map(split_unit, chosen), strict=True))
    if len(set(names)) < len(set(chosen)):  # they would not differ without their units
        names = chosen
    if unit_lines:
        units = [strip_brackets(cell) or unit for cell, unit in zip(unit_lines[0], units, strict=True)]
    names = [name or f"column {k}" for k, name in enumerate(names, start=1)]
    places = {name: names.index(name) for name in names}
    # Every other line names the columns as well, for `columns=`, unless the same word stands above several columns, as
    # a group does.
    for line in [chosen, *name_lines]:
        once = {cell for cell, count in Counter(line).items() if cell and count == 1}
        places |= {cell: k for k, cell in enumerate(line) if cell in once and cell not in places}
    return names, units, places


def _is_unit_line(cells: list[str]) -> bool:
    """Return whether most of the cells are units."""
    filled = [cell for cell in cells if cell]
    return sum(map(is_unit, filled)) > 0.6 * len(filled)
