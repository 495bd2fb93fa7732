"""Settings for all tests: the same examples in every run, strict promotion, programs that compile quickly."""

import gc
import os
import signal
from pathlib import Path

import jax
import llvmlite.binding
import pytest
from hypothesis import settings

import switchfit as sf
from switchfit.batch import batch
from switchfit.batch import layout as batch_layout
from switchfit.engine.native import program_cache
from switchfit.engine.native.llvm import compilation
from switchfit.engine.native.program_cache import drop_programs
from switchfit.models import heater_problem
from switchfit.uncertainty import derivative_check

# Tracing allocates so much that the default of 700 has the collector at work for a sixth of the time of such tests.
gc.set_threshold(400_000, 20, 10)

settings.register_profile("switchfit", derandomize=True, deadline=None)
settings.load_profile("switchfit")

PROMOTION = {"jax_numpy_dtype_promotion": ("strict", "standard"), "jax_numpy_rank_promotion": ("raise", "allow")}
"""JAX's settings in the tests, and its defaults.

switchfit's own code must not rely on implicit conversions: an int32 that meets a float64, or a vector that is taken for
a row of a matrix, is more often a mistake than meant. Users' functions may, and JAX's defaults are in force for them;
tests of such functions are marked with `promotes`.
"""

for name, (strict, _) in PROMOTION.items():
    jax.config.update(name, strict)

# Nearly all programs of the tests run for milliseconds, and compiling them is most of what the tests take. Without the
# emitters of fusions by way of MLIR it takes half the time; with one module of LLVM for each program, in place of up
# to 32 for as many threads, and without passes that simplify loops, up to a fifth less. XLA reads its flags once,
# when it compiles first. Processes that tests start have XLA's defaults, as users do, unless they ask for
# `quick_processes`.
DEFAULT_FLAGS = os.environ.get("XLA_FLAGS", "")
QUICK_FLAGS = (
    f"{DEFAULT_FLAGS} --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
    " --xla_disable_hlo_passes=while-loop-invariant-code-motion,simplify-while-loops"
)

jax.config.update("jax_disable_most_optimizations", True)
os.environ["XLA_FLAGS"] = QUICK_FLAGS
jax.jit(lambda: 0)()
os.environ["XLA_FLAGS"] = DEFAULT_FLAGS


AS_USERS = llvmlite.binding.Target.create_target_machine, compilation.compile_modules


def pytest_configure(config):
    """Make machine code without optimisation too, unless slow or long random tests are asked for.

    The cache must not hand it to others: a comment in the text of a program gives it a key of its own.
    """
    if config.getoption("markexpr") != "not slow and not fuzz":
        return
    create, compile_modules = AS_USERS

    def create_quickly(self, **settings):
        return create(self, **(settings | {"opt": 0}))

    def compile_quickly(texts):
        return compile_modules(f"{text}\n; without optimisation\n" for text in texts)

    llvmlite.binding.Target.create_target_machine = create_quickly
    compilation.compile_modules = program_cache.compile_modules = compile_quickly


TOGETHER = ("test_adjoint", "test_machine_code", "test_prediction")
"""Files that share the programs of `systems.case`, which are most of what they take: one process runs them all."""

BEGIN_FIRST = (
    "program simulated_runs multistart many_estimates chunks docs losses_priors_delays both_engines several_runs "
    "free_final_time claims html_page zero_times_nan beam insertion_rates found_sequences verdicts_of_searches "
    "searches_kept named_inputs stiffness tutorial jumps commands choice_of_strategies ends_of_searches known_order "
    "many_starts hops other_minima files docstrings starts_benchmark closed_forms random_systems "
    "intervals_of_many guards known_answers time_units bootstrap examples estimate refinement vehicles figures "
    "verdict dates modes_command"
)
LONGEST = [*TOGETHER, *(f"test_{name}" for name in BEGIN_FIRST.split())]
"""Files that begin first, so that no process works alone for long at the end."""


def pytest_collection_modifyitems(items):
    """Put the longest files first."""
    items.sort(key=lambda item: LONGEST.index(item.path.stem) if item.path.stem in LONGEST else len(LONGEST))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Return the scheduler of `--dist loadfile`, for which the files of `TOGETHER` are one, and the order is kept."""
    if config.getoption("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class ByPrograms(LoadFileScheduling):
        def _split_scope(self, nodeid):
            file = super()._split_scope(nodeid)
            return TOGETHER[0] if Path(file).stem in TOGETHER else file

    config.option.loadscopereorder = False
    return ByPrograms(config, log)


@pytest.fixture(scope="module")
def optimised_machine_code():
    """Machine code as users have it, to the last bit."""
    drop_programs()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(llvmlite.binding.Target, "create_target_machine", AS_USERS[0])
        for module in (compilation, program_cache):
            patch.setattr(module, "compile_modules", AS_USERS[1])
        yield
    drop_programs()


@pytest.fixture(scope="module")
def fits_one_by_one():
    """Many fits are done one by one, as those are whose model raises an error: no program is compiled for them.

    For tests of what is printed, drawn and written about such fits, which is the same; a program takes 2 s.
    """

    def refuse(*given, **settings):
        raise ValueError("error calling callback: none was called")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch, "minimize_fits", refuse)
        patch.setattr(batch_layout, "runs_natively", lambda *given: False)  # evaluations are done one by one too
        yield


@pytest.fixture
def quick_certificates(monkeypatch):
    """Certificates take the paper's equations for right, and do not evaluate them: no program is compiled for them.

    For tests of what else is saved, printed and drawn of a fit, which is the same; a program takes 1 s.
    """
    monkeypatch.setattr(derivative_check, "measure_closing_gap", lambda *given: (0.0, 0.0))


@pytest.fixture
def quick_processes(monkeypatch):
    """Processes that the test starts compile as this one does, so that they find its programs in the cache."""
    monkeypatch.setenv("XLA_FLAGS", QUICK_FLAGS)
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """A headless Chromium."""
    from support.browser import Browser, find_browser

    if find_browser() is None:
        pytest.skip("no Chromium on this machine")
    opened = Browser(tmp_path_factory.mktemp("chromium"))
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def heater():
    """The fit of the built-in problem of a heater that is switched off."""
    return sf.estimate(heater_problem(), strategy="local")


MOST_MAPPINGS = 55_000
"""Pieces of memory that a process may map before compiled programs are dropped; the kernel allows 65,530."""


@pytest.fixture
def interrupted_fits(monkeypatch):
    """Every fit of the command line is interrupted by Ctrl-C in its first iteration."""
    real = sf.estimate

    def estimate(problem, callback, **options):
        def interrupted(record):
            signal.raise_signal(signal.SIGINT)
            return callback(record)

        return real(problem, callback=interrupted, **options)

    monkeypatch.setattr(sf, "estimate", estimate)


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
def _drop_programs():
    """Drop compiled programs where they are many: those of all tests together need more mappings, and XLA crashes.

    After every file it would cost: the small programs that all files share are then compiled again and again.
    """
    yield
    maps = Path("/proc/self/maps")  # on Linux, where the limit is
    if maps.exists() and maps.read_bytes().count(b"\n") > MOST_MAPPINGS:
        jax.clear_caches()
        drop_programs()
