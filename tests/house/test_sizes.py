"""`python -m benchmarks sizes` counts what it says, in a tree that is written here."""

import textwrap

import pytest

from benchmarks import sizes

FILES = {
    "src/switchfit/fit/one.py": '''\
        """One thing.

        What a reader needs to know of it, on
        two lines.

        Another thing of a module that is gone.

        And what a reader needs to know of that.
        """

        from typing import Any

        from switchfit.report import text

        MOST, LEAST = 3, 0.5  # why


        class Point:
            """A point."""

            def move(self, by: Any) -> Any:
                """Return it moved."""
                return by


        LATE = 1
        ''',
    "src/switchfit/report/two.py": '''\
        """Another.

        If it has no title of another subject, it is none.

        Even so.
        """

        from importlib import import_module

        MOST = 4


        def load(name: str) -> object:
            # noqa: this is no comment
            return import_module(f"switchfit.report.{name}")


        class Point:
            """Another point."""
        ''',
    "tests/house/test_rooms.py": 'LAYERS = ("fit", "report")\n',
}


@pytest.fixture
def tree(tmp_path):
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(text))
    return tmp_path


def test_what_is_counted(tree):
    found = sizes.measure(str(tree))
    expected = {
        "lines of code": "12",
        "files": "2",
        "lines of imports": "3",
        "glued headers": ["fit/one.py"],
        "late assignments": ["fit/one.py:26"],
        "  of all": "3",
        "names with several values": ["MOST"],
        "public classes twice": ["Point"],
        "uses of Any": "2",
        "comments per 100 lines of code": "8.3",
        "imports up": ["fit/one.py imports report"],
        "imports by string": ["report/two.py: switchfit.report.{name}"],
        "  fit: code, files": "7, 1",
        "  report: code, files": "5, 1",
    }
    assert {name: found[name] for name in expected} == expected
    assert found["longest function"] == "1 fit/one.py: move"


def test_trees_stand_side_by_side(tree, capsys, monkeypatch):
    monkeypatch.chdir(tree)
    sizes.main([str(tree), "."])
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].split() == ["files", "2", "2"]
    assert "  fit/one.py imports report" in lines


def test_what_is_no_tree_is_refused(tmp_path):
    with pytest.raises(SystemExit, match="has no Python files"):
        sizes.measure(str(tmp_path))
    with pytest.raises(SystemExit, match="neither a folder nor a revision"):
        sizes.measure("no such revision")
