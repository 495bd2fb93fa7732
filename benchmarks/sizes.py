"""How large the code is, of revisions or folders side by side: ``python -m benchmarks sizes REVISION HEAD src``.

What is counted, by the syntax tree of every Python file of the package:

- lines of code, without blanks, comments and strings that stand alone, as docstrings do; all lines; files;
- the longest function, the longest class, the longest file;
- *records*: dataclasses and NamedTuples that hold a trajectory or an evaluation, which are those whose name ends in one
  of `ENDINGS`;
- *ways to a Hessian*: functions and methods whose name has one of `SECOND_ORDER` in it, each name once.

Both lists follow from names alone, so they are printed in full for the reader to judge: a helper counts, too.
"""

from __future__ import annotations

import ast
import io
import subprocess
import sys
import tarfile
import tempfile
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
PACKAGE = "src/switchfit"

ENDINGS = (
    "Comparison", "Derivatives", "Evaluation", "Path", "Prediction", "Sensitivities", "Sensitivity", "Simulation",
    "Trajectory",
)  # fmt: skip
NO_CODE = (
    tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.COMMENT, tokenize.ENDMARKER,
)  # fmt: skip
SECOND_ORDER = ("derivatives", "gauss_newton", "hessian", "second_order")


def main(revisions: list[str]) -> None:
    """Print a table with a column for each revision (or folder), then the lists behind its counts."""
    columns = {revision: measure(revision) for revision in revisions or ["HEAD"]}
    rows = list(next(iter(columns.values())))
    table = [("", *columns)] + [(row, *(shown(found[row]) for found in columns.values())) for row in rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for line in table:
        print("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip())
    for revision, found in columns.items():
        for row, value in found.items():
            if isinstance(value, list):
                print(f"\n{row}, {revision}:\n  {', '.join(value)}")


def shown(value: Any) -> str:
    """Return an entry of the table: of a list, its length."""
    return str(len(value)) if isinstance(value, list) else str(value)


def measure(revision: str) -> dict[str, Any]:
    """Return the sizes of the package in a folder, or in a revision of this repository."""
    if Path(revision).is_dir():
        return measure_folder(Path(revision))
    archive = subprocess.run(["git", "archive", revision, PACKAGE], cwd=ROOT, capture_output=True)
    if archive.returncode != 0:
        sys.exit(f"{revision!r} is neither a folder nor a revision with {PACKAGE}: {archive.stderr.decode().strip()}")
    with tempfile.TemporaryDirectory() as folder, tarfile.open(fileobj=io.BytesIO(archive.stdout)) as tar:
        tar.extraction_filter = getattr(tarfile, "data_filter", None)  # Python 3.11 has it from 3.11.4 on
        tar.extractall(folder)
        return measure_folder(Path(folder) / PACKAGE)


def measure_folder(folder: Path) -> dict[str, Any]:
    """Return the sizes of all Python files in a folder."""
    texts = {path.relative_to(folder).as_posix(): path.read_text() for path in sorted(folder.rglob("*.py"))}
    if not texts:
        sys.exit(f"{folder} holds no Python files.")
    lines = {file: len(text.splitlines()) for file, text in texts.items()}
    nodes = [(file, node) for file, text in texts.items() for node in ast.walk(ast.parse(text))]
    functions = [(file, node) for file, node in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    classes = [(file, node) for file, node in nodes if isinstance(node, ast.ClassDef)]
    return {
        "lines of code": sum(map(count_code, texts.values())),
        "lines": sum(lines.values()),
        "files": len(texts),
        "longest file": f"{max(lines.values())} {max(lines, key=lines.__getitem__)}",
        "longest function": longest(functions),
        "  without its docstring": longest(functions, docstring=False),
        "longest class": longest(classes),
        "records": sorted(f"{node.name} ({file})" for file, node in classes if is_record(node)),
        "ways to a Hessian": sorted({node.name for _, node in functions if any(w in node.name for w in SECOND_ORDER)}),
    }


def count_code(text: str) -> int:
    """Return the number of lines that hold code."""
    said = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            said.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    code = {line for token in tokens if token.type not in NO_CODE for line in range(token.start[0], token.end[0] + 1)}
    return len(code - said)


def longest(found: list[tuple[str, Any]], docstring: bool = True) -> str:
    """Return the length, file and name of the longest definition."""
    sizes = {(file, node.name): size_of(node, docstring) for file, node in found}
    if not sizes:
        return "none"
    (file, name), size = max(sizes.items(), key=lambda item: item[1])
    return f"{size} {file}: {name}"


def size_of(node: Any, docstring: bool) -> int:
    """Return the number of lines of a definition, decorators left out."""
    first = node.body[0]
    said = first.end_lineno - first.lineno + 1 if ast.get_docstring(node) is not None else 0
    return node.end_lineno - node.lineno + 1 - (0 if docstring else said)


def is_record(node: ast.ClassDef) -> bool:
    """Return whether a class is a dataclass or a NamedTuple that holds a trajectory or an evaluation, by its name."""
    decorators: Iterator[str] = (ast.unparse(decorator) for decorator in node.decorator_list)
    bases = [ast.unparse(base) for base in node.bases]
    return node.name.endswith(ENDINGS) and ("NamedTuple" in bases or any("dataclass" in d for d in decorators))
