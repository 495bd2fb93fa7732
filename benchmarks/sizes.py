"""What drifts in the code, of trees side by side: ``python -m benchmarks sizes [FOLDER or REVISION ...]``.

By the syntax trees of all Python files of the package, without running them. A tree has `src/switchfit` and, for the
order of its rooms, `tests/**/test_rooms.py`. These are signals and no aims: a reader judges the lists below the table.

- *Lines of code* hold code: no blanks, comments, docstrings. *Lines of imports* are those among them.
- A header is *glued* if a paragraph of the module's docstring, not the first, is one sentence on one line that does
  not begin with a condition, and another paragraph follows that is no section: the title of another subject.
- Assignments are *late* if a function or a class of the module comes before them.
- A constant's name has *several values* if modules assign it different numbers.
- *By string* is an import of a module of the package whose name is a text.
"""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tarfile
import tempfile
import tokenize
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGE = Path("src/switchfit")
NO_CODE = (
    tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.COMMENT, tokenize.ENDMARKER,
)  # fmt: skip
TITLE = re.compile(r"(?!(?:If|Where|When|While|Since|With|Without|As|For|In|At|On|To) )[A-Z`][^\n]*\.")
DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
MOST_LISTED = 12


def main(trees: list[str]) -> None:
    """Print a table with a column for each tree, then what is behind its counts."""
    columns = {tree: measure(tree) for tree in trees or ["."]}
    names = list(dict.fromkeys(name for found in columns.values() for name in found))
    table = [("", *columns)] + [(name, *(show(found.get(name, "")) for found in columns.values())) for name in names]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for line in table:
        print("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip())
    for tree, found in columns.items():
        for name, value in found.items():
            if isinstance(value, list) and value:
                more = f", and {len(value) - MOST_LISTED} more" if len(value) > MOST_LISTED else ""
                print(f"\n{name}, {tree}:\n  {', '.join(value[:MOST_LISTED])}{more}")


def show(value: str | list[str]) -> str:
    """Return a cell of the table: of a list, its length."""
    return str(len(value)) if isinstance(value, list) else value


def measure(tree: str) -> dict[str, str | list[str]]:
    """Return the counts of a tree: of a folder, or of a revision of this repository."""
    if Path(tree).is_dir():
        return measure_folder(Path(tree))
    archive = subprocess.run(["git", "archive", tree, str(PACKAGE), "tests"], cwd=ROOT, capture_output=True)
    if archive.returncode != 0:
        sys.exit(f"{tree!r} is neither a folder nor a revision with {PACKAGE}: {archive.stderr.decode().strip()}")
    with tempfile.TemporaryDirectory() as folder, tarfile.open(fileobj=io.BytesIO(archive.stdout)) as tar:
        tar.extraction_filter = getattr(tarfile, "data_filter", None)  # Python 3.11 has it from 3.11.4 on
        tar.extractall(folder)
        return measure_folder(Path(folder))


def measure_folder(root: Path) -> dict[str, str | list[str]]:
    """Return what is counted, by name: text, or a list that is shown by its length."""
    package = root / PACKAGE
    texts = {path.relative_to(package).as_posix(): path.read_text() for path in sorted(package.rglob("*.py"))}
    if not texts:
        sys.exit(f"{root} has no Python files in {PACKAGE}.")
    trees = {file: ast.parse(text) for file, text in texts.items()}
    code = {file: count_code(text, trees[file]) for file, text in texts.items()}
    rooms = Counter[str]()
    for file, lines in code.items():
        rooms[room_of(file)] += lines
    files = Counter(map(room_of, texts))
    longest = max(texts, key=lambda file: texts[file].count("\n"))
    assigned = [(file, node, is_late) for file, tree in trees.items() for node, is_late in list_assignments(tree)]
    comments = sum(map(count_comments, texts.values()))
    layers = read_layers(root)
    return {
        "lines of code": str(sum(code.values())),
        "files": str(len(texts)),
        "lines of imports": str(sum(map(count_imports, trees.values()))),
        "longest file": f"{texts[longest].count(chr(10))} {longest}",
        "longest function": find_longest(trees),
        "glued headers": [file for file, tree in trees.items() if is_glued(ast.get_docstring(tree) or "")],
        "late assignments": [f"{file}:{node.lineno}" for file, node, is_late in assigned if is_late],
        "  of all": str(len(assigned)),
        "names with several values": find_ambiguous(node for _, node, _ in assigned),
        "public classes twice": find_repeated_classes(trees),
        "uses of Any": str(sum(len(re.findall(r"(?::|->)\s*Any\b", text)) for text in texts.values())),
        "comments per 100 lines of code": f"{100 * comments / sum(code.values()):.1f}",
        "imports up": [line for file, tree in trees.items() for line in find_upward(file, tree, layers)],
        "imports by string": [f"{file}: {name}" for file, tree in trees.items() for name in find_strings(tree)],
        **{f"  {room}: code, files": f"{rooms[room]}, {files[room]}" for room in sorted(rooms, key=str)},
    }


def room_of(file: str) -> str:
    """Return the room of a file of the package, given from there: ``fit/result.py`` is in "fit"."""
    return file.partition("/")[0].removesuffix(".py")


def count_code(text: str, tree: ast.Module) -> int:
    """Return the number of lines that hold code."""
    said: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            said.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    code = {line for token in tokens if token.type not in NO_CODE for line in range(token.start[0], token.end[0] + 1)}
    return len(code - said)


def count_comments(text: str) -> int:
    """Return the number of comments, without those that only a tool reads."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return sum(token.type == tokenize.COMMENT and not re.match(r"# (noqa|fmt|type):", token.string) for token in tokens)


def count_imports(tree: ast.Module) -> int:
    """Return the number of lines of imports, wherever they are."""
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    return sum((node.end_lineno or node.lineno) - node.lineno + 1 for node in imports)


def find_longest(trees: dict[str, ast.Module]) -> str:
    """Return the length, without its docstring, and the name of the longest function."""
    sizes = {}
    for file, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                first = node.body[ast.get_docstring(node) is not None :] or node.body
                sizes[f"{file}: {node.name}"] = (node.end_lineno or 0) - first[0].lineno + 1
    name = max(sizes, key=lambda each: sizes[each], default="")
    return f"{sizes[name]} {name}" if name else "0"


def is_glued(docstring: str) -> bool:
    """Return whether a module's docstring has the title of another subject in it."""
    prose = re.split(r"^\w+\n---", docstring, flags=re.MULTILINE)[0]
    paragraphs = [paragraph for paragraph in prose.strip().split("\n\n") if paragraph.strip()]
    return any(TITLE.fullmatch(each) and ". " not in each for each in paragraphs[1:-1])


def list_assignments(tree: ast.Module) -> Iterator[tuple[ast.Assign | ast.AnnAssign, bool]]:
    """List the assignments of a module, and whether a definition comes before each."""
    is_late = False
    for node in tree.body:
        is_late = is_late or isinstance(node, DEFINITIONS)
        if isinstance(node, ast.Assign | ast.AnnAssign):
            yield node, is_late


def find_ambiguous(assignments: Iterator[ast.Assign | ast.AnnAssign]) -> list[str]:
    """Return the names in capitals to which modules assign different numbers."""
    values = defaultdict(set)
    for node in assignments:
        for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
            pairs = [(target, node.value)]
            if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                pairs = list(zip(target.elts, node.value.elts, strict=True))
            for name, value in pairs:
                is_number = isinstance(value, ast.Constant) and isinstance(value.value, int | float)
                if isinstance(name, ast.Name) and name.id.isupper() and is_number:
                    values[name.id].add(value.value)
    return sorted(name for name, given in values.items() if len(given) > 1)


def find_repeated_classes(trees: dict[str, ast.Module]) -> list[str]:
    """Return the names that several public classes have."""
    nodes = (node for tree in trees.values() for node in ast.walk(tree) if isinstance(node, ast.ClassDef))
    counts = Counter(node.name for node in nodes)
    return sorted(name for name, count in counts.items() if count > 1 and not name.startswith("_"))


def read_layers(root: Path) -> tuple[str, ...]:
    """Return the rooms of a tree from the bottom to the top, as its test of them has them; none without that test."""
    for path in root.glob("tests/**/test_rooms.py"):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "LAYERS":
                return tuple(ast.literal_eval(node.value))
    return ()


def find_upward(file: str, tree: ast.Module, layers: tuple[str, ...]) -> list[str]:
    """Return the imports of a file, anywhere in it, of rooms that come after its own."""
    own, found = room_of(file), set()
    for node in ast.walk(tree):
        whole = [f"{node.module}.{a.name}" for a in node.names] if isinstance(node, ast.ImportFrom) else []
        whole += [a.name for a in node.names] if isinstance(node, ast.Import) else []
        found |= {name.split(".")[1] for name in whole if name.startswith("switchfit.")}
    up = [room for room in found if {own, room} <= {*layers} and layers.index(room) > layers.index(own)]
    return [f"{file} imports {room}" for room in sorted(up)]


def find_strings(tree: ast.Module) -> Iterator[str]:
    """Yield the modules of the package that are imported by a text."""
    for node in ast.walk(tree):
        is_call = isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module")
        if (
            is_call
            and node.args
            and (text := ast.unparse(node.args[0]).lstrip("f").strip("'\"")).startswith("switchfit")
        ):
            yield text
