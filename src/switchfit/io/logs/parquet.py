"""Parquet files, read by pyarrow."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from switchfit.io.logs.columns import build_log
from switchfit.io.logs.log import Log
from switchfit.io.logs.options import Options
from switchfit.io.logs.refusals import explain_damage
from switchfit.runtime.extras import import_library


def read_parquet(path: Path, options: Options) -> Log:
    """Read the columns of a Parquet file; units are those in the metadata of the fields, or of pandas.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    parquet = import_library("pyarrow.parquet", f"{path}: Parquet", "'switchfit[parquet]'")
    # To NumPy inside as well: a damaged page is noticed only when its values are decoded.
    with explain_damage(path, "a Parquet file"):
        table = parquet.read_table(path)
        columns = {name: table.column(name).to_numpy() for name in table.column_names}
    zones = {field.name: getattr(field.type, "tz", None) or "" for field in table.schema}
    return build_log(str(path), columns, _find_units(table.schema), options, zones=zones)


def _find_units(schema: Any) -> dict[str, str]:
    """Return units from the metadata "unit" or "units" of each field, and from the attrs that pandas writes."""
    # DataFrame.attrs are written by pandas since 2.1; what is in a field's own metadata is nearer, and wins.
    pandas = json.loads((schema.metadata or {}).get(b"pandas", b"{}"))
    attributes = pandas.get("attributes", {})
    units = dict(attributes.get("units", {})) if isinstance(attributes, dict) else {}
    for field in schema:
        metadata = field.metadata or {}
        stated = metadata.get(b"units", metadata.get(b"unit"))
        if stated is not None:
            units[field.name] = stated.decode("utf-8", "replace")
    return {name: unit for name, unit in units.items() if isinstance(unit, str)}
