"""Tables: collected while the benchmarks run, printed and written at the end."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"


def format_table(header: tuple[str, ...], rows: list[tuple[Any, ...]]) -> list[str]:
    """Return a Markdown table as lines."""
    lines = ["| " + " | ".join(header) + " |", "|" + "|".join("---" for _ in header) + "|"]
    return lines + ["| " + " | ".join(str(entry) for entry in row) + " |" for row in rows]


@dataclass
class Report:
    """Sections of Markdown tables, the raw figures, and targets that were set beforehand."""

    machine: dict[str, Any]
    lines: list[str] = field(default_factory=list)
    data: dict[str, Any] = field(default_factory=dict)
    targets: list[tuple[str, str, str, bool]] = field(default_factory=list)

    def section(self, title: str, text: str = "") -> None:
        """Begin a section."""
        self._say(f"\n## {title}\n")
        if text:
            self._say(text + "\n")

    def table(self, header: tuple[str, ...], rows: list[tuple[Any, ...]]) -> None:
        """A Markdown table."""
        for line in format_table(header, rows):
            self._say(line)
        self._say("")

    def note(self, text: str) -> None:
        """A line of text."""
        self._say(text + "\n")

    def target(self, what: str, wanted: float, found: float, unit: str, *, at_least: bool = False) -> None:
        """A figure that was set as a goal, beside what was measured."""
        reached = found >= wanted if at_least else found <= wanted
        sign = ">=" if at_least else "<="
        self.targets.append((what, f"{sign} {wanted:g} {unit}", f"{found:.3g} {unit}", reached))

    def close(self, name: str) -> None:
        """Print the targets and write ``results/<name>.json`` and ``.md``."""
        self.section("Targets")
        marks = {True: "reached", False: "**missed**"}
        self.table(("", "target", "measured", ""), [(*rest, marks[reached]) for *rest, reached in self.targets])
        packages = ", ".join(f"{name} {number}" for name, number in self.machine["packages"].items())
        self.note(
            f"{self.machine['cpu']}, {self.machine['cores']} cores, {self.machine['system']}; Python "
            f"{self.machine['python']}; {packages}. Load at the start: {self.machine['load']}."
        )
        RESULTS.mkdir(exist_ok=True)
        (RESULTS / f"{name}.md").write_text("\n".join(["# Benchmarks", *self.lines]), encoding="utf-8")
        targets = [dict(zip(("what", "target", "measured", "reached"), row, strict=True)) for row in self.targets]
        content = {"machine": self.machine, "targets": targets, **self.data}
        (RESULTS / f"{name}.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
        print(f"written to {RESULTS / name}.md and .json")

    def _say(self, line: str) -> None:
        print(line, flush=True)
        self.lines.append(line)
