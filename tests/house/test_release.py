"""What is published: files, versions, and a wheel that works at both ends of the supported versions.

The slow tests (`make release-check`) build the distributions and install them into new environments, so they download
packages. Each Python that is not on this machine is skipped.
"""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

import switchfit as sf
from support.places import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
OLDEST, NEWEST = "3.11", "3.13"

FIT = """
from importlib.metadata import version
from pathlib import Path

import switchfit as sf
from switchfit.models import heater_problem

assert Path(sf.__file__).is_relative_to({prefix!r}), sf.__file__
assert Path(sf.__file__).with_name("py.typed").exists()
assert sf.__version__ == version("switchfit")
estimate = sf.estimate(heater_problem())
assert estimate.success and estimate.engine.name == "native", estimate
assert abs(estimate.theta - [2.5, 0.4]).max() < 0.1, estimate.theta
"""


def test_versions_agree():
    """The version is that of the project, the package, the citation and the first version of the changes."""
    version = PROJECT["version"]
    assert sf.__version__ == version
    assert re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.M)[1] == version
    headings = re.findall(r"^## (.+)$", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert next(heading for heading in headings if heading != "Unreleased") == version


def read_lowest():
    """Return a pip constraint for the lowest supported version of each dependency."""
    bounds = {re.match(r"[\w-]+", entry)[0]: re.search(r">=([\d.]+)", entry) for entry in PROJECT["dependencies"]}
    assert all(bounds.values()), "a dependency without a lower bound"
    return [f"{name}=={bound[1]}.*" for name, bound in bounds.items()]


def find_python(version):
    """Return the path of a Python of that version, and skip the test where there is none."""
    names = [shutil.which(name) for name in (f"python{version}", "python3", sys.executable)]
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    for path in [*names, *pyenv.glob(f"versions/{version}.*/bin/python")]:
        if path and run(path, "-c", "import sys; print('%d.%d' % sys.version_info[:2])").stdout.strip() == version:
            return path
    pytest.skip(f"there is no Python {version}")


def run(*command, folder=None, check=False):
    """Run a command without this environment's packages, and show what it printed if it fails."""
    kept = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}
    done = subprocess.run([str(part) for part in command], cwd=folder, env=kept, capture_output=True, text=True)
    assert not check or done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done


@pytest.fixture(scope="session")
def distributions(tmp_path_factory):
    """The wheel and the source distribution; the wheel is built from the source distribution."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--outdir", folder, ROOT, check=True)
    (wheel,), (source,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, source


@pytest.mark.slow
def test_what_the_distributions_hold(distributions):
    wheel, source = distributions
    name = f"switchfit-{PROJECT['version']}"
    assert wheel.name == f"{name}-py3-none-any.whl"
    packed = set(zipfile.ZipFile(wheel).namelist())
    library = {p.relative_to(ROOT / "src").as_posix() for p in (ROOT / "src").rglob("*") if p.is_file()}
    assert {path for path in library if "__pycache__" not in path} <= packed, "files that the wheel lacks"
    assert {path.partition("/")[0] for path in packed} == {"switchfit", f"{name}.dist-info"}
    assert {f"{name}.dist-info/licenses/LICENSE", "switchfit/examples/toss/problem.toml"} <= packed
    with tarfile.open(source) as archive:
        sources = {path.removeprefix(f"{name}/") for path in archive.getnames()}
    assert {"LICENSE", "CITATION.cff", "CHANGELOG.md", "README.md", "tests/house/test_release.py"} <= sources
    assert wheel.stat().st_size < 2e6, "the wheel has something large in it"
    assert source.stat().st_size < 5e6, "the source distribution has something large in it"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("python", "lowest"),
    [(OLDEST, ""), (OLDEST, None), (NEWEST, "jax=="), (NEWEST, None)],
    ids=["oldest, lowest dependencies", "oldest, newest dependencies", "newest, lowest JAX", "newest, newest"],
)
def test_a_fresh_installation_fits(python, lowest, distributions, tmp_path):
    """Install the wheel into a new environment, fit, run the command."""
    constraints = [one for one in read_lowest() if lowest is not None and one.startswith(lowest)]
    environment = tmp_path / "env"
    run(find_python(python), "-m", "venv", environment, check=True)
    (tmp_path / "constraints.txt").write_text("\n".join(constraints))
    pip = [environment / "bin" / "python", "-m", "pip", "--disable-pip-version-check", "--quiet", "install"]
    run(*pip, "-c", tmp_path / "constraints.txt", distributions[0], check=True)
    script = FIT.format(prefix=str(environment.resolve()))
    run(environment / "bin" / "python", "-W", "error", "-c", script, folder=tmp_path, check=True)
    shutil.copytree(ROOT / "examples" / "toss", tmp_path / "toss")
    command = environment / "bin" / "switchfit"
    done = run(command, "fit", tmp_path / "toss" / "problem.toml", "--out", tmp_path / "out", check=True)
    assert re.search(r"^ *mu +0\.\d+", done.stdout, re.M), done.stdout
    assert (tmp_path / "out" / "estimate.json").exists()
