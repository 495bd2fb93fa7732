"""The tests notice mistakes in the mathematics: each of `mutate.MISTAKES` makes one of them fail."""

import tempfile
from pathlib import Path

import pytest

from support import drawn
from support.mutate import MISTAKES, SELECTIONS, SOURCE, TESTS, copy_package, find_failure, mutate


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache") / "programs"


@pytest.mark.parametrize(("part", "name"), MISTAKES)
def test_a_mistake_is_in_the_source(part, name):
    changed = mutate(part, name)
    assert changed
    assert all(text != (SOURCE / path).read_text() for path, text in changed.items())


def test_every_folder_has_tests_that_notice_its_mistakes():
    folders = {path.parent.relative_to(SOURCE).as_posix() for path in SOURCE.rglob("*.py")} - {"."}
    assert folders <= drawn.TESTS.keys()


def test_what_is_drawn_does_not_depend_on_how_a_room_is_cut_into_files(tmp_path):
    """Nor on a line that is added; a room has `PER_ROOM` mistakes with all its folders."""

    def draw(files):
        source = Path(tempfile.mkdtemp(dir=tmp_path))
        for name, text in files.items():
            (source / "engine" / name).parent.mkdir(parents=True, exist_ok=True)
            (source / "engine" / name).write_text(text)
        return {(folder, name.partition(": ")[2]) for folder, name, *_ in drawn.draw_mistakes(source)}

    functions = [f"def f{k}(x):\n    return x + {k} < {k}\n" for k in range(5)]
    found = draw({"one.py": "\n".join(functions)})
    assert len(found) == drawn.PER_ROOM
    assert found == draw({"two.py": "\n".join(functions[:2]), "three.py": "# more\n" + "\n".join(functions[2:])})
    below = draw({"two.py": "\n".join(functions[:2]), "jax/three.py": "\n".join(functions[2:])})
    assert {name for _, name in below} == {name for _, name in found}


@pytest.mark.slow
@pytest.mark.parametrize("part", TESTS)
def test_without_a_mistake_the_tests_pass(part, cache, tmp_path):
    assert find_failure(copy_package(tmp_path), part, cache) is None


@pytest.mark.slow
@pytest.mark.parametrize(("part", "name"), MISTAKES)
def test_a_mistake_is_noticed(part, name, cache, tmp_path):
    package = copy_package(tmp_path)
    for path, text in mutate(part, name).items():
        (package / path).write_text(text)
    assert find_failure(package, part, cache) is not None, f"no test of {SELECTIONS[part]} fails"
