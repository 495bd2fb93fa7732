"""The page of the documentation that says what has machine code, and what JAX has to do."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from functions import FALLS_BACK

from switchfit.engine.native import arrays, trace

PAGE = Path(__file__).resolve().parent.parent / "docs" / "engines.md"


def rows_of(section):
    """Rows of the table of a section: lists of cells."""
    text = PAGE.read_text().split(f"## {section}\n")[1].split("\n## ")[0]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"][2:]


def names_in(cell):
    return re.findall(r"`([^`]*)`", cell)


def test_the_page_names_what_jax_has_to_do():
    left = {name for _, examples in rows_of("JAX") for name in names_in(examples)}
    reasons = [reason for reason in FALLS_BACK.values() if "(limit" not in reason]
    called = {found[1] for reason in reasons if (found := re.match(r"calls ([\w.]+\w)", reason))}
    assert len(called) > 10
    assert not called - left


def test_the_page_claims_machine_code_only_for_what_has_it():
    written = {name for _, examples, _ in rows_of("Machine code") for name in names_in(examples)}
    fallen = {name for name in written for why in FALLS_BACK.values() if f"calls {name}" in why and "(limit" not in why}
    assert len(written) > 30
    assert not fallen


@pytest.mark.parametrize(
    ("row", "limits"),
    [
        ("branches, loops", (trace.MOST_NODES,)),
        ("tables of numbers", (arrays.MOST_ROWS_OF_TABLE,)),
        ("tables of parameters", (arrays.MOST_CHOICES,)),
        ("indices that depend", (arrays.MOST_CHOICES,)),
        ("linear systems", (arrays.MOST_ROWS_TO_PIVOT,)),
        ("Cholesky", (arrays.MOST_ROWS, arrays.MOST_KNOWN_ROWS)),
        ("sorting", (arrays.MOST_SORTED,)),
    ],
)
def test_the_limits_on_the_page_are_those_of_the_code(row, limits):
    (cell,) = (limit for what, _, limit in rows_of("Machine code") if what.startswith(row))
    assert tuple(map(int, re.findall(r"\d+", cell))) == limits
