"""Settings for all tests: the same examples in every run, and compiled programs let go after each file."""

import jax
import pytest
from hypothesis import settings

from switchfit.engine.native.program import drop_programs

settings.register_profile("switchfit", derandomize=True, deadline=None)
settings.load_profile("switchfit")


@pytest.fixture(scope="module", autouse=True)
def _programs_let_go():
    """A process may map some 65,000 pieces of memory; the programs of all tests together need more, and XLA crashes."""
    yield
    jax.clear_caches()
    drop_programs()
