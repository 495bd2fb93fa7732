"""Seed mistakes into the mathematics, one at a time, and see that the tests notice each of them.

Run as ``python tests/mutate.py``, or with the names of some parts: paper, rows, native, sqp. Every mistake is a
replacement in a temporary copy of the package, whose text must be found exactly once; the tests of its part then run
against the copy and must fail, while they must pass without a mistake. Exits with 1 if a mistake survives, with 2 if
its text is not found or the tests fail without any.
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

PAPER, ROWS = "paper_adjoint.py", "discretization/rows.py"
ALGEBRA = "optimize/algebra.py"
KERNELS, DRIVER, TEMPLATES = (f"engine/native/{name}.py" for name in ("kernels", "driver", "templates"))

SYSTEMS = ["tests/test_random_systems.py", "-k", "machine_code or in_jax"]
PROTOCOL = ["tests/test_protocol.py"]
TESTS = {
    "paper": [["tests/test_adjoint.py"]],
    "rows": [SYSTEMS],
    "native": [SYSTEMS, PROTOCOL],
    "sqp": [["tests/test_sqp.py", "tests/test_qp.py"]],
}
"""What must notice the mistakes of each part, one after the other until something does."""

Replacements = list[tuple[str, str]]

IN_PAPER: dict[str, Replacements] = {
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
            "compute_tau_tau(i, here, adjoints, minus, plus)",
            "compute_tau_tau(i, here, adjoints, minus, plus, "
            "[evaluate_transition(model, path, i, tau[j], p).D1f_im1 for j in range(i)])",
        ),
        (
            "def compute_tau_tau("
            "i: int, here: Transition, adjoints: Adjoints, minus: Sensitivities, plus: Sensitivities)",
            "def compute_tau_tau(i, here, adjoints, minus, plus, misprinted)",
        ),
        ("X_ij = D1f_im1 @ minus.Phi_X[:, j]", "X_ij = misprinted[j] @ minus.Phi_X[:, j]"),
    ],
    "zero cross block, (3)": [("        H = H.at[i, N:].set(row[N:]).at[N:, i].set(row[N:])\n", "")],
}

IN_ROWS: dict[str, Replacements] = {
    "h' in the tangents of the stages": [
        ("X_d = X_d if h_d is None else _plus(X_d, h_d, combine(tableau.a[j], slopes))", "X_d = X_d")
    ],
    "h' in the tangent behind a row": [
        ("after if h_d is None else _plus(after, h_d, combine(tableau.b, slopes))", "after")
    ],
    "D_1 f in the tangents": [("times_vector(f_x[j], X_d) + forcing[j]", "times_vector(f_x[j], x_d) + forcing[j]")],
    "later stages in the adjoint": [("_sum(b[j] * psi if b[j] else None, later)", "_sum(b[j] * psi, None)")],
    "a transposed in the adjoint": [("[a[m][j] for m in range(j + 1, s)]", "[a[m][m - 1] for m in range(j + 1, s)]")],
    "psi in the adjoint": [("psi + sum(mu[1:], mu[0])", "sum(mu[1:], mu[0])")],
    "ell in what the length multiplies": [("((psi * slopes[j]).sum() + densities[j])", "(psi * slopes[j]).sum()")],
    "mu in what the length multiplies": [
        ("total = total + (mu[j] * inside).sum()", "total = total + 0.0 * inside.sum()")
    ],
    "times of the stages": [("[start_d + c * h_d for c", "[end_d - c * h_d for c")],
}

IN_NATIVE: dict[str, tuple[str, Replacements]] = {
    "the time of a transition in a node": (
        KERNELS,
        [('g = g + g_t.item() * graph.load("moves", 0, vector=True)', "g = g + 0.0")],
    ),
    "the jump of the costate at a node": (
        KERNELS,
        [
            (
                '        stores += _stored("jump", 0, graph.loads("jump", self.sizes.n) + derivatives[1])\n'
                "        return stores + self._scalar(graph, derivatives, moving)\n\n    def _weights",
                "        return stores + self._scalar(graph, derivatives, moving)\n\n    def _weights",
            )
        ],
    ),
    "the penalty in the weight of a constraint": (
        KERNELS,
        [('graph.loads("multiplier", count) + graph.loads("penalty", count) * c', 'graph.loads("multiplier", count)')],
    ),
    "half of the mixed entries in Z' S Z": (
        KERNELS,
        [("for one, other in {(k, m), (m, k)}:", "for one, other in {(k, m)}:")],
    ),
    "the length of a row in the Hessian": (
        KERNELS,
        [('+ graph.load("length", d) * (end_d - start_d)', "+ 0.0 * (end_d - start_d)")],
    ),
    "the reset map of another transition": (
        DRIVER,
        [
            (
                '"moves": self.at(found["units"], "%segment", width),\n            "x_after"',
                '"moves": found["units"],\n            "x_after"',
            )
        ],
    ),
    "the sample behind a transition": (DRIVER, [("icmp sge i64 {cell}, {begin}", "icmp sgt i64 {cell}, {begin}")]),
    "the costate of a late sample": (
        DRIVER,
        [('{"late": self.at(found["late"], row, n)})', '{"late": found["late"]})')],
    ),
    "W in the Gauss-Newton matrix": (TEMPLATES, [("return factor * apply_weights(W, A)", "return factor * A")]),
}

IN_SQP: dict[str, tuple[str, Replacements]] = {
    "absolute values of eigenvalues": (
        ALGEBRA,
        [("replaced = xp.maximum(xp.abs(values), EIGENVALUE_REPLACEMENT)", "replaced = xp.maximum(values, 1e-3)")],
    ),
    "the decrease that a step must achieve": (
        ALGEBRA,
        [("((decrease <= noise) | (cost <= before - fraction * decrease))", "(cost <= before + 1e300 * fraction)")],
    ),
    "the size in what is active": (ALGEBRA, [("16 * EPS * (abs_b + abs_A @ size)", "0.0 * (abs_b + abs_A @ size)")]),
    "bounds that press are reached exactly": (
        ALGEBRA,
        [("xp.where(at_low, low, xp.where(at_high, high, step))", "xp.where(at_low, 0.999 * low, step)")],
    ),
}


def mutated(source: str, replacements: list[tuple[str, str]]) -> str:
    """`source` with each text replaced; exits with 2 unless it occurs exactly once."""
    for old, new in replacements:
        if source.count(old) != 1:
            print(f"found {source.count(old)} times instead of once: {old!r}")
            sys.exit(2)
        source = source.replace(old, new)
    return source


def run_tests(package: Path, tests: list[list[str]]) -> tuple[bool, str]:
    """Whether one of some runs of tests fails against the package below a folder, and the first test that does."""
    environment = os.environ | {"PYTHONPATH": str(package), "PYTHONDONTWRITEBYTECODE": "1", "SWITCHFIT_CACHE": "off"}
    for selection in tests:
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", *selection]
        found = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
        failed = re.findall(r"^(?:FAILED|ERROR) \S+?::(.*?)(?: - .*)?$", found.stdout, re.MULTILINE)
        if found.returncode not in (0, 1) or (found.returncode == 1 and not failed):
            print(found.stdout[-3000:], found.stderr[-3000:])
            sys.exit(2)
        if found.returncode == 1:
            return True, failed[0]
    return False, "none"


def mistakes(part: str) -> dict[str, tuple[str, Replacements]]:
    """The mistakes of a part: where, and what is replaced."""
    if part == "paper":
        return {name: (PAPER, replacements) for name, replacements in IN_PAPER.items()}
    if part == "rows":
        return {name: (ROWS, replacements) for name, replacements in IN_ROWS.items()}
    return {"native": IN_NATIVE, "sqp": IN_SQP}[part]


def main(parts: list[str]) -> int:
    """Run all mistakes of some parts and print what noticed them; the number of survivors decides the exit status."""
    survivors = count = 0
    source = ROOT / "src" / "switchfit"
    for part in parts or list(TESTS):
        variants = {
            name: (path, mutated((source / path).read_text(), replacements))
            for name, (path, replacements) in mistakes(part).items()
        }
        with tempfile.TemporaryDirectory() as folder:
            package = Path(folder)
            shutil.copytree(source, package / "switchfit")
            failed, test = run_tests(package, TESTS[part])
            if failed:
                print(f"without any mistake {test} fails")
                return 2
            print(f"{part + ': mistake':46} {'':8} first test that fails", flush=True)
            for name, (path, text) in variants.items():
                (package / "switchfit" / path).write_text(text)
                started = time.monotonic()
                caught, test = run_tests(package, TESTS[part])
                (package / "switchfit" / path).write_text((source / path).read_text())
                survivors, count = survivors + (not caught), count + 1
                verdict = "caught" if caught else "SURVIVES"
                print(f"{name:46} {verdict:8} {test} ({time.monotonic() - started:.0f} s)", flush=True)
    print(f"{count - survivors} of {count} mistakes caught")
    return int(survivors > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
