"""What a user writes, of which mypy has no complaint, runs: `tests/typing_user.py`."""

import pytest

from support import typing_user


@pytest.mark.slow
def test_it_runs(tmp_path):
    found = typing_user.use(typing_user.make_problem(), tmp_path)
    assert all(type(number) is float for number in found)
