"""The tests notice mistakes in the mathematics: each of `mutate.MISTAKES` makes one of them fail."""

import pytest

from support.mutate import MISTAKES, SELECTIONS, SOURCE, TESTS, copy_package, find_failure, mutate


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache") / "programs"


@pytest.mark.parametrize(("part", "name"), MISTAKES)
def test_a_mistake_is_in_the_source(part, name):
    changed = mutate(part, name)
    assert changed
    assert all(text != (SOURCE / path).read_text() for path, text in changed.items())


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
