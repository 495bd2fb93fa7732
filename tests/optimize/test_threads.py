"""One thread for the optimizer's linear algebra, and the user's number of threads for the user's code."""

import ctypes
import re
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg.lapack  # noqa: F401  # its BLAS has to be loaded to be among those below

import switchfit as sf
from support.optimizer import box, minimize
from switchfit.models import heater_problem
from switchfit.optimize.threads import find_libraries, one_thread, with_own_threads

MAPS = Path("/proc/self/maps")

pytestmark = pytest.mark.skipif(
    not MAPS.exists() or "openblas" not in MAPS.read_text(), reason="no OpenBLAS, or no list of loaded libraries"
)

USERS = 3
"""A number of threads that no environment of the tests has."""


def loaded_libraries():
    """Functions that read and set the threads of each OpenBLAS that is loaded, found by its file."""
    for path in sorted(set(re.findall(r"(/\S*openblas\S*\.so\S*)", MAPS.read_text()))):
        library = ctypes.CDLL(path)
        for affixes in ("scipy_{}64_", "scipy_{}", "{}64_", "{}"):
            if hasattr(library, affixes.format("openblas_set_num_threads")):
                yield tuple(getattr(library, affixes.format(f"openblas_{verb}_num_threads")) for verb in ("get", "set"))
                break


LIBRARIES = list(loaded_libraries())


def count_threads():
    return {get() for get, _ in LIBRARIES}


@pytest.fixture(autouse=True)
def users_threads():
    before = [get() for get, _ in LIBRARIES]
    for _, put in LIBRARIES:
        put(USERS)
    yield
    after = count_threads()
    for (_, put), threads in zip(LIBRARIES, before, strict=True):
        put(threads)
    assert after == {USERS}  # after every test here, whatever happened in it


class Bowl:
    """½ |theta - 1|², and the numbers of threads while it is evaluated."""

    def __init__(self, fail=False):
        self.seen, self.fail = [], fail

    def __call__(self, theta, side):
        self.seen.append(count_threads())
        if self.fail:
            raise ZeroDivisionError
        self.cost, self.gradient, self.hessian = 0.5 * (theta - 1) @ (theta - 1), theta - 1, np.eye(len(theta))
        return self


def test_one_thread_in_the_optimizer_and_the_users_number_after_it():
    """Also after an exception: `users_threads` looks."""
    assert len(find_libraries()) >= len(LIBRARIES) > 0
    bowl, failing = Bowl(), Bowl(fail=True)
    assert minimize(bowl, np.zeros(3), constraints=box(np.zeros(3), np.full(3, 0.5))).status.successful
    with pytest.raises(ZeroDivisionError):
        minimize(failing, np.zeros(3), constraints=box(np.zeros(3), np.full(3, 0.5)))
    assert len(bowl.seen) > 0
    assert all(seen == {1} for seen in (*bowl.seen, *failing.seen))


def test_a_callers_function_has_its_own_number_also_after_an_exception():
    def fail():
        assert count_threads() == {USERS}
        raise ZeroDivisionError

    with one_thread():
        with pytest.raises(ZeroDivisionError):
            with_own_threads(fail)()
        assert count_threads() == {1}


def test_the_last_of_two_threads_restores_the_number():
    entered, left = threading.Event(), threading.Event()

    def stay_shorter():
        with one_thread():
            entered.set()
            inside.wait(10)
        left.set()

    inside = threading.Event()
    other = threading.Thread(target=stay_shorter)
    other.start()
    assert entered.wait(10)
    with one_thread():
        inside.set()
        assert left.wait(10)
        assert count_threads() == {1}
    other.join()


def test_the_callback_of_a_fit_has_the_users_number_and_may_fit():
    seen = []

    def callback(record):
        seen.append(count_threads())
        sf.estimate(heater_problem(), strategy="local")
        seen.append(count_threads())

    assert sf.estimate(heater_problem(), strategy="local", callback=callback).success
    assert seen
    assert all(each == {USERS} for each in seen)


def test_a_model_that_calls_python_has_the_users_number():
    seen = []

    def look_up(x):
        seen.append(count_threads())
        return np.zeros((), np.int32)

    @jax.custom_jvp
    def same(x):
        looked_up = jax.pure_callback(look_up, jax.ShapeDtypeStruct((), jnp.int32), x, vmap_method="sequential")
        return x + looked_up.astype(x.dtype)

    same.defjvp(lambda primals, tangents: (same(*primals), tangents[0]))
    system = sf.HybridSystem({"decay": lambda t, x, p: -0.4 * p["k"] * jnp.stack([same(x[0])])}, [1.0])
    times = np.array([0.5, 1.0, 1.5])
    data = sf.Measurements(times, np.exp(-0.6 * times), sigma=0.1)
    problem = sf.Problem(system, sf.Experiment(data, ("decay",), (), 0.0, 1.5), {"k": 1.0})
    fit = sf.estimate(problem, strategy="local")
    assert fit.engine.name == "jax"
    assert fit.parameters["k"] == pytest.approx(1.5, rel=1e-6)
    assert seen
    assert all(each == {USERS} for each in seen)
