"""The keys of problem files, written into tables when the documentation is built."""

from __future__ import annotations

import inspect
import math
import re
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import switchfit as sf
from switchfit.io.problem_file import tables

SECTIONS = {
    "parameters": tables.ParameterTable,
    "experiments": tables.ExperimentTable,
    "data": tables.DataTable,
    "inputs": tables.InputTable,
    "library": tables.LibraryTable,
    "online": tables.OnlineTable,
    "design": tables.DesignTable,
    "options": tables.OptionsTable,
}
"""The tables of a file; those of logs stand under data, and are left out under inputs."""


def write(folder: Path) -> None:
    """Write keys-SECTION.md for each section."""
    folder.mkdir(exist_ok=True)
    for name in SECTIONS:
        (folder / f"keys-{name}.md").write_text(build_table(name), encoding="utf-8")


def build_table(name: str) -> str:
    """Return the keys of a section with what they mean, their values and what they are if left out."""
    fields = SECTIONS[name].model_fields
    if name == "inputs":
        fields = {key: field for key, field in fields.items() if key not in tables.LogTable.model_fields}
    defaults = find_defaults() if name == "options" else {}
    texts = tables.describe_keys(SECTIONS[name])
    rows = [
        f"| `{key}` | {describe(texts[key], field, defaults.get(key, field.default))} |"
        for key, field in fields.items()
    ]
    return "\n".join(["| key | meaning |", "|---|---|", *rows, ""])


def find_defaults() -> dict[str, Any]:
    """Return the defaults of `estimate` and `Problem`, which the options have where a file leaves them out."""
    signatures = (inspect.signature(sf.Problem), inspect.signature(sf.estimate))
    return {name: item.default for signature in signatures for name, item in signature.parameters.items()}


def describe(text: str, field: Any, default: Any) -> str:
    """Return the description of a field, the values among which one chooses, and what it is if left out."""
    parts = [re.sub(r"(?<!\w)'([^']+)'(?!\w)", r'`"\1"`', text)]
    values = [f'`"{value}"`' for value in list_values(field.annotation)]
    if not all(value in parts[0] for value in values):
        parts.append(f"one of {', '.join(values)}")
    if field.is_required():
        parts.append("must be given")
    elif isinstance(default, str) and default:
        parts.append(f'left out, `"{default}"`')
    elif type(default) in (int, float) and math.isfinite(default):
        parts.append(f"left out, {default:g}")
    return "; ".join(parts)


def list_values(annotation: Any) -> tuple[Any, ...]:
    """Return the values of a type that has a few."""
    if get_origin(annotation) is Literal:
        return get_args(annotation)
    return next((values for part in get_args(annotation) if (values := list_values(part))), ())
