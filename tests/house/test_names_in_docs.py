"""Every name in backticks, on the developers' pages and in the docstrings of the library, is the name of something.

What is a name, and where it is looked up:

- On a page and in a docstring, what stands in single backticks. In double ones of a docstring stands code
  (expressions, values, shell commands, keys of files), unless it begins with a class of the library.
- A text with a slash or a file's ending is a path: of the repository, of the package, or the end of one.
- Identifiers joined by dots, with or without a call behind them, are a name. Everything else is code.
- A name with dots begins with a module of the library, a class, a function, or what can be imported (`jax`, `sf`). The
  rest are attributes, one after the other: those of a class also of its bases, and what methods set.
- A name without dots is a module, a definition of a module, an attribute of a class, or a builtin; in a docstring also
  an argument or a variable of the function that it stands in or of one around it; on a page a public argument.
"""

import ast
import builtins
import keyword
import re
import sys
from collections import defaultdict
from functools import cache
from importlib import import_module
from operator import attrgetter
from pathlib import Path

import pytest

import switchfit as sf
from support.places import ROOT

PACKAGE = ROOT / "src" / "switchfit"
PAGES = ("docs/internals.md", "docs/paper.md", "CONTRIBUTING.md")

IMPORTED = {"jnp": "jax.numpy", "np": "numpy", "plt": "matplotlib.pyplot", "sf": "switchfit"}
"""Names under which users import; other libraries go by their own."""

FOREIGN = {"daqp", "jax", "llvmlite", "matplotlib", "numpy", "pydantic", "pymap3d", "scipy", "switchfit", "typer"}
FOREIGN |= sys.stdlib_module_names
"""Libraries whose names may stand in backticks."""

NO_NAMES = {"slow"}
"""Words in backticks that look like names and are none: a marker of tests."""

PATH = re.compile(r"[\w./<>*-]+")
ENDINGS = (".py", ".pyi", ".md", ".rst", ".toml", ".js", ".html", ".json", ".csv", ".yml", ".yaml")
NAME = re.compile(r"([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*)(?:\(.*\))?", re.DOTALL)

Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef


class Scope:
    """What is defined in a module or in a class: names, and the scopes of those that have one."""

    def __init__(self, node):
        self.names, self.scopes, self.bases = set(), {}, []
        if isinstance(node, ast.ClassDef):
            self.bases = [ast.unparse(base).partition("[")[0].rpartition(".")[2] for base in node.bases]
            for inner in ast.walk(node):
                if isinstance(inner, ast.Attribute) and ast.unparse(inner.value) in ("self", "cls"):
                    self.names.add(inner.attr)
        for child in walk_statements(node.body):
            if isinstance(child, Definition):
                self.names.add(child.name)
                if isinstance(child, ast.ClassDef):
                    self.scopes[child.name] = Scope(child)
            for target in targets_of(child):
                self.names |= {name.id for name in ast.walk(target) if isinstance(name, ast.Name)}


def walk_statements(body):
    """Statements of a scope, also those under `if` and `try`, without those of definitions."""
    for node in body:
        yield node
        if isinstance(node, ast.If | ast.Try | ast.With | ast.For):
            yield from walk_statements(node.body)
            yield from walk_statements(getattr(node, "orelse", []))


def targets_of(node):
    if isinstance(node, ast.Assign):
        return node.targets
    return [node.target] if isinstance(node, ast.AnnAssign | ast.For) else []


@cache
def read_scopes():
    """Scopes of all modules of the library, of the tests' helpers and of the benchmarks, by the module's whole name."""
    scopes = {}
    for top in (PACKAGE, ROOT / "tests", ROOT / "benchmarks"):
        for path in sorted(top.rglob("*.py")):
            parts = path.relative_to(top.parent).with_suffix("").parts
            parts = parts[:-1] if parts[-1] == "__init__" else parts
            scopes[".".join(parts)] = Scope(ast.parse(path.read_text()))
    return scopes


@cache
def find_modules():
    """Modules by every end of their names: `walk`, `corners.walk`, `problem.corners.walk`."""
    found = defaultdict(list)
    for whole in read_scopes():
        parts = whole.split(".")
        for k in range(len(parts)):
            found[".".join(parts[k:])].append(whole)
    return found


@cache
def find_classes():
    found = defaultdict(list)
    for scope in read_scopes().values():
        for name, inner in scope.scopes.items():
            found[name].append(inner)
    return found


@cache
def all_names():
    """Every definition of a module and every attribute of a class."""
    scopes = [*read_scopes().values()]
    inner = [each for scope in scopes for each in scope.scopes.values()]
    return set().union(*(scope.names for scope in [*scopes, *inner]))


@cache
def public_arguments():
    """Arguments of public functions and of the methods of public classes, and fields of records."""
    found = set()
    for name in sf.__all__:
        whole = f"switchfit.{sf._MODULES[name]}"
        path = ROOT / "src" / (whole.replace(".", "/"))
        path = path.with_suffix(".py") if path.with_suffix(".py").exists() else path / "__init__.py"
        for node in ast.parse(path.read_text()).body:
            if getattr(node, "name", None) == name:
                found |= {each.arg for each in ast.walk(node) if isinstance(each, ast.arg)}
    return found


def has_attribute(scope, rest):
    """Whether a scope, or one of its bases, has the attributes, one after the other."""
    first, *more = rest
    bases = [base for name in scope.bases for base in find_classes().get(name, ())]
    if not (first in scope.names or any(has_attribute(base, [first]) for base in bases)):
        return False
    inner = scope.scopes.get(first)
    return not more or (has_attribute(inner, more) if inner else first in find_classes() or more[0] in all_names())


def can_be_imported(name):
    first, _, rest = name.partition(".")
    if hasattr(builtins, first):
        return hasattr(getattr(builtins, first), rest)
    if first not in IMPORTED and first not in FOREIGN:
        return False
    top = import_module(IMPORTED.get(first, first))
    for parts in range(len(rest.split(".")) + 1):
        module, attributes = ".".join(rest.split(".")[:parts]), ".".join(rest.split(".")[parts:])
        try:
            found = import_module(f"{top.__name__}.{module}".rstrip("."))
            if not attributes or attrgetter(attributes)(found) is not None:
                return True
        except (ImportError, AttributeError):
            continue
    return has_fields(rest)


def has_fields(rest):
    """Whether `rest` is a class of ours with the attribute, as fields of instances are."""
    parts = rest.split(".")
    return len(parts) > 1 and any(has_attribute(scope, parts[1:]) for scope in find_classes().get(parts[0], ()))


def exists(name, local=frozenset()):
    """Whether a name is that of something; `local` are names that it may have where it stands."""
    parts = name.split(".")
    if parts[0] in local or name in NO_NAMES:
        return True
    if len(parts) == 1:
        known = hasattr(builtins, name) or keyword.iskeyword(name) or name in FOREIGN
        return known or name in all_names() or name in find_modules()
    for k in range(len(parts), 0, -1):
        for whole in find_modules()[".".join(parts[:k])]:
            if not parts[k:] or has_attribute(read_scopes()[whole], parts[k:]):
                return True
    return any(has_attribute(scope, parts[1:]) for scope in find_classes().get(parts[0], ())) or can_be_imported(name)


def is_path(text):
    return bool(PATH.fullmatch(text)) and ("/" in text or text.endswith(ENDINGS))


@cache
def read_paths():
    tops = [path for path in ROOT.iterdir() if path.name not in (".git", ".venv", ".mypy_cache")]
    paths = [path for top in tops for path in (top, *(top.rglob("*") if top.is_dir() else ()))]
    return ["/" + path.relative_to(ROOT).as_posix() for path in paths]


def path_exists(text):
    return any(path.endswith("/" + text.strip("/")) for path in read_paths())


def is_there(text, local=frozenset()):
    """Whether what stands in backticks is code, a path that exists, or a name of something."""
    text = " ".join(text.split())
    if is_path(text):
        return path_exists(text) or text.split("/")[0] in ("out",) or "<" in text or "*" in text
    found = NAME.fullmatch(text)
    return not found or exists(found[1], local)


@pytest.mark.parametrize("page", PAGES)
def test_names_on_the_pages_of_developers_exist(page):
    text = re.sub(r"^```.*?^```$", "", (ROOT / page).read_text(), flags=re.MULTILINE | re.DOTALL)
    local = public_arguments()
    quoted = re.findall(r"(?<!`)`([^`]+)`(?!`)", text)
    assert len(quoted) > 20
    missing = []
    for entry in quoted:
        file, colon, function = entry.partition(".py: ")
        parts = [f"{file}.py", f"{Path(file).name}.{function}"] if colon else [entry]
        missing += [part for part in parts if not is_there(part, local)]
    assert not missing, "\n".join(missing)


def docstrings_of(tree):
    """(line, text, names that it may use) of each docstring, and of each text below an assignment."""

    def visit(node, local):
        inner = local
        if isinstance(node, Definition):
            inner = local | {each.arg for each in ast.walk(node) if isinstance(each, ast.arg)}
            inner |= {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}
        for child in ast.iter_child_nodes(node):
            value = getattr(child, "value", None)
            if isinstance(child, ast.Expr) and isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield child.lineno, value.value, inner
            yield from visit(child, inner)

    return visit(tree, frozenset())


def test_names_in_docstrings_exist():
    missing = []
    for path in sorted(PACKAGE.rglob("*.py")):
        for line, text, local in docstrings_of(ast.parse(path.read_text())):
            code = re.findall(r"``(.*?)``", text, re.DOTALL)
            names = [each for each in code if each.partition(".")[0] in find_classes()]
            names += re.findall(r"`([^`]+)`", re.sub(r"``.*?``", "", text, flags=re.DOTALL))
            missing += [f"{path.relative_to(PACKAGE)}:{line}: {name}" for name in names if not is_there(name, local)]
    assert not missing, "\n".join(missing)
