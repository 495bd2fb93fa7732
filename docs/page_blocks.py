"""The blocks of Python on a page, run in order: figures come from the code that the page shows."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any


def run_blocks(page: str) -> dict[str, Any]:
    """Run the Python blocks of a page of this folder and return what they define."""
    text = (Path(__file__).parent / page).read_text(encoding="utf-8")
    names: dict[str, Any] = {"__name__": "__main__"}
    for block in re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        exec(compile(block, page, "exec"), names)
    return names
