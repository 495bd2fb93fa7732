"""Settings for all tests: the same examples in every run, strict promotion, programs dropped after each file."""

import jax
import pytest
from hypothesis import settings

from switchfit.engine.native.program import drop_programs

settings.register_profile("switchfit", derandomize=True, deadline=None)
settings.load_profile("switchfit")

PROMOTION = {
    "jax_numpy_dtype_promotion": ("strict", "standard"),
    "jax_numpy_rank_promotion": ("raise", "allow"),
}
"""JAX's settings in the tests, and its defaults.

switchfit's own code must not rely on implicit conversions: an int32 that meets a float64, or a vector that is taken for
a row of a matrix, is more often a mistake than meant. Users' functions may, and JAX's defaults are in force for them;
tests of such functions are marked with `promotes`.
"""

for name, (strict, _) in PROMOTION.items():
    jax.config.update(name, strict)


@pytest.fixture(autouse=True)
def _promotion(request):
    """JAX's defaults for a test that is marked with `promotes`; in all threads, which a context would not be."""
    if request.node.get_closest_marker("promotes") is None:
        yield
        return
    for name, (_, default) in PROMOTION.items():
        jax.config.update(name, default)
    yield
    for name, (strict, _) in PROMOTION.items():
        jax.config.update(name, strict)


@pytest.fixture(scope="module", autouse=True)
def _programs_let_go():
    """A process may map some 65,000 pieces of memory; the programs of all tests together need more, and XLA crashes."""
    yield
    jax.clear_caches()
    drop_programs()
