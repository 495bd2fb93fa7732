"""Seed ten mistakes into the paper's equations, one at a time, and see that the tests notice each of them.

Run as ``python tests/mutate.py``. Every mistake is a replacement in a temporary copy of the package, whose text must
be found exactly once; tests/test_adjoint.py then runs against the copy and must fail, while it must pass without a
mistake. Exits with 1 if a mistake survives, with 2 if its text is not found or the tests fail without any.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MODULE = Path("switchfit") / "paper_adjoint.py"

MUTANTS: dict[str, list[tuple[str, str]]] = {
    "sign of X, (8)": [("X = f_im1 - f_i  # (8)", "X = f_i - f_im1  # (8)")],
    "coefficient of X_ii 2 -> 1, (13)": [("- 2 * D1f_i @ f_im1", "- 1 * D1f_i @ f_im1")],
    "dropped D ell X, (11)": [("second = second - here.Dell @ X + psi", "second = second + psi")],
    "dropped psi . D1^2 f, (12)": [(" - contract(psi, d.D1D1f) - d.D1f.T", " - d.D1f.T")],
    "dropped DpD1 f, (15)": [("d.D1D1f @ d.Dp_x + d.DpD1f)", "d.D1D1f @ d.Dp_x)")],
    "dropped Dp f jump, (17)": [(" + here.Dpf_im1 - here.Dpf_i  # (17)", "  # (17)")],
    "dropped D2 f jump, (13)": [(" + D2f_im1 - D2f_i  # (13)", "  # (13)")],
    "dropped D1Dp f Dp_x, (14)": [(" + contract(psi, d.D1Dpf @ d.Dp_x)", "")],
    "tau_j for tau_i, (13), the misprint": [
        (
            "tau_tau(i, here, adjoints, minus, plus)",
            "tau_tau(i, here, adjoints, minus, plus, "
            "[transition_at(model, path, i, tau[j], p).D1f_im1 for j in range(i)])",
        ),
        (
            "def tau_tau(i: int, here: Transition, adjoints: Adjoints, minus: Sensitivities, plus: Sensitivities)",
            "def tau_tau(i, here, adjoints, minus, plus, misprinted)",
        ),
        ("X_ij = D1f_im1 @ minus.Phi_X[:, j]", "X_ij = misprinted[j] @ minus.Phi_X[:, j]"),
    ],
    "zero cross block, (3)": [("        H = H.at[i, N:].set(row[N:]).at[N:, i].set(row[N:])\n", "")],
}


def mutated(source: str, replacements: list[tuple[str, str]]) -> str:
    """`source` with each text replaced; exits with 2 unless it occurs exactly once."""
    for old, new in replacements:
        if source.count(old) != 1:
            print(f"found {source.count(old)} times instead of once: {old!r}")
            sys.exit(2)
        source = source.replace(old, new)
    return source


def run_tests(package: Path) -> tuple[bool, str]:
    """Whether tests/test_adjoint.py fails against the package below a folder, and the first test that does."""
    environment = os.environ | {"PYTHONPATH": str(package), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", "tests/test_adjoint.py"]
    found = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    failed = re.findall(r"^FAILED \S+?::(.*?)(?: - .*)?$", found.stdout, re.MULTILINE)
    if found.returncode not in (0, 1) or (found.returncode == 1 and not failed):
        print(found.stdout[-3000:], found.stderr[-3000:])
        sys.exit(2)
    return found.returncode == 1, failed[0] if failed else "none"


def main() -> int:
    """Run all mutants and print what noticed them; the number of survivors decides the exit status."""
    survivors = 0
    source = (ROOT / "src" / MODULE).read_text()
    variants = {name: mutated(source, replacements) for name, replacements in MUTANTS.items()}
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder)
        shutil.copytree(ROOT / "src" / "switchfit", package / "switchfit")
        failed, test = run_tests(package)
        if failed:
            print(f"without any mistake {test} fails")
            return 2
        print(f"{'mistake':38} {'':8} first test that fails")
        for name, text in variants.items():
            (package / MODULE).write_text(text)
            started = time.monotonic()
            caught, test = run_tests(package)
            survivors += not caught
            verdict = "caught" if caught else "SURVIVES"
            print(f"{name:38} {verdict:8} {test} ({time.monotonic() - started:.0f} s)", flush=True)
    print(f"{len(variants) - survivors} of {len(variants)} mistakes caught")
    return int(survivors > 0)


if __name__ == "__main__":
    sys.exit(main())
