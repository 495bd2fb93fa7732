"""Parquet files, by pyarrow."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from switchfit.io.logs.libraries import explain_damage, import_library
from switchfit.io.logs.log import Log, Options
from switchfit.io.logs.tables import build_log
from switchfit.runtime.files import explain_read_errors


def read_parquet(path: Path, options: Options) -> Log:
    """Read the columns of a Parquet file; units are those in the metadata of the fields, or of pandas.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    parquet = import_library("pyarrow.parquet", "parquet", f"{path}: Parquet")
    with explain_read_errors(path):
        path.open("rb").close()
    with explain_damage(path, "a Parquet file"):
        table = parquet.read_table(path)
        columns = {name: table.column(name).to_numpy() for name in table.column_names}
    zones = {field.name: getattr(field.type, "tz", None) or "" for field in table.schema}
    return build_log(str(path), columns, _find_units(table.schema), options, zones=zones)


def _find_units(schema: Any) -> dict[str, str]:
    """Return units from the metadata "unit" or "units" of each field, and from the attrs that pandas writes."""
    pandas = json.loads((schema.metadata or {}).get(b"pandas", b"{}"))
    attributes = pandas.get("attributes", {})
    units = dict(attributes.get("units", {})) if isinstance(attributes, dict) else {}
    for field in schema:
        metadata = field.metadata or {}
        stated = metadata.get(b"units", metadata.get(b"unit"))
        if stated is not None:
            units[field.name] = stated.decode("utf-8", "replace")
    return {name: unit for name, unit in units.items() if isinstance(unit, str)}
