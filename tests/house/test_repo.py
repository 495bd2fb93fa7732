"""The repository itself: documented, small, free of what does not belong in it."""

import ast
import re
import subprocess
from pathlib import Path

import pytest

from support.places import ROOT
from switchfit.io.problem_file import tables as keys


def tracked():
    """Every file git knows or would add; skips where this is no clone."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    try:
        listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git clone")
    return [path for name in listed.split("\0") if name and (path := ROOT / name).is_file()]


def test_every_key_of_problem_files_is_described_and_in_the_reference(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    import key_pages

    page = (ROOT / "docs" / "problem-file.md").read_text()
    reference = page + "".join(map(key_pages.build_table, key_pages.SECTIONS))
    tables = [t for t in vars(keys).values() if isinstance(t, type) and issubclass(t, keys.TomlTable)]
    for table in tables:
        described = keys.describe_keys(table)
        for key in table.model_fields:
            assert described[key], f"{table.__name__}.{key}"
            assert re.search(rf"\b{key}\b", reference), key
    assert all(f"_generated/keys-{name}.md" in page for name in key_pages.SECTIONS)
    options = key_pages.build_table("options")
    for key, default in (("rtol", "1e-08"), ("tolerance", "1e-07"), ("max_iterations", "200"), ("solver", '`"auto"`')):
        assert re.search(rf"^\| `{key}` .* left out, {default} \|$", options, re.MULTILINE), key


def test_links_in_the_pages_lead_somewhere():
    for page in [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            assert "://" in target or (page.parent / target).exists(), f"{page.name}: {target}"


def test_each_equation_of_the_paper_is_listed_and_its_function_and_its_test_exist():
    page = (ROOT / "docs" / "paper.md").read_text()
    rows = re.findall(r"^\| \((\d+)\) \|[^|]+\| `([\w/]+\.py): (\w+)` \| [^|]+ \|$", page, re.M)
    assert [int(number) for number, _, _ in rows] == list(range(1, 19))
    for number, file, name in rows:
        text = (ROOT / "src/switchfit" / file).read_text()
        functions = (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef))
        function = next(node for node in functions if node.name == name)
        assert f"({number})" in ast.get_source_segment(text, function), f"{file}: {name} lacks ({number})"
    for file, test in re.findall(r"`(test_\w+\.py): (\w+)`", page):
        (path,) = (ROOT / "tests").rglob(file)
        assert re.search(rf"^def {test}\b", path.read_text(), re.M), f"{file}: {test}"


def test_internals_name_every_room_and_files_that_exist():
    page = (ROOT / "docs" / "internals.md").read_text()
    rooms = {path.stem for path in (ROOT / "src/switchfit").glob("[!_]*") if path.is_dir() or path.suffix == ".py"}
    table = page[page.index("| room |") : page.index("## Data flow")]
    assert {name for row in re.findall(r"^\| (`.*?) \|", table, re.M) for name in re.findall(r"`(\w+)`", row)} == rooms
    named = re.findall(r"`([\w/]+(?:/|\.py|\.md|\.js|\.rst))[`:]", page)
    assert len(named) > 60
    tops = [path for path in ROOT.iterdir() if path.name not in (".git", ".venv")]
    known = [path.relative_to(ROOT).as_posix() + "/" * path.is_dir() for top in tops for path in (top, *top.rglob("*"))]
    missing = [name for name in named if not any(f"/{path}".endswith(f"/{name}") for path in known)]
    assert not missing


def test_nothing_large_and_nothing_generated_is_kept():
    endings = {".png", ".pdf", ".pyc", ".so", ".pt", ".pkl", ".npz", ".ipynb"}
    assert not [path for path in tracked() if path.stat().st_size > 1_000_000 or path.suffix in endings]


FORBIDDEN = {
    "an absolute path of one machine": r"(?<![\w.<])/(work|home|root|Users|tmp)/\w",
    "the number of an issue": r"(?i)\b(issue|pull request|PR) ?#?\d+",
    "a package registry": r"pypi\.org|pythonhosted|anaconda\.org",
    "a merge conflict": r"^(<{7}|>{7}) ",
    "something left to do": r"\b(TO" + r"DO|FIX" + r"ME|X" + r"XX)\b",
}


@pytest.mark.parametrize("what", FORBIDDEN)
def test_nothing_in_the_tree_that_does_not_belong(what):
    texts = [path for path in tracked() if path != Path(__file__) and path.suffix not in {".csv", ".svg"}]
    pattern = re.compile(FORBIDDEN[what], re.M)
    found = {str(path): pattern.search(path.read_text(encoding="utf-8")) for path in texts}
    assert not {name: match.group() for name, match in found.items() if match}
