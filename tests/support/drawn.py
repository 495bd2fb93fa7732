"""Mistakes drawn over all rooms by a rule, for `mutate.MISTAKES`: not by hand, which would draw where tests look.

The rule: in each room with its folders, of all comparisons, sums, products and conjunctions in its functions the
`PER_ROOM` whose lines have the smallest hashes, each replaced by its opposite. A line stays drawn until it is changed,
in whichever file of its room it stands.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator
from pathlib import Path

PER_ROOM = 2

OPPOSITES: dict[type[ast.AST], tuple[str, str]] = {
    ast.Lt: ("<", ">="),
    ast.LtE: ("<=", ">"),
    ast.Gt: (">", "<="),
    ast.GtE: (">=", "<"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"),
    ast.In: ("in", "not in"),
    ast.NotIn: ("not in", "in"),
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.And: ("and", "or"),
    ast.Or: ("or", "and"),
}

NAMES = {
    "batch": "program simulated_runs multistart many_estimates chunks intervals_of_many bootstrap many_logs "
    "verdicts_of_many starts_benchmark",
    "cli": "commands modes_command saved_estimates information designs design_command online_command "
    "first_problem many_logs",
    "discretization": "rows_and_nodes hard_moments hidden_switches implicit_rows random_systems stiffness both_engines "
    "closed_forms",
    "engine": "closed_forms corner_branches corner_derivatives sliding paths_not_followed friction_and_tanks "
    "corners_at_known_times rows_and_nodes stiffness following both_engines machine_code",
    "engine/adaptive": "stiffness implicit_rows rows_and_nodes following",
    "engine/corners": "closed_forms corner_derivatives sliding paths_not_followed friction_and_tanks",
    "engine/jax": "both_engines closed_forms random_systems insertion_rates",
    "engine/native": "machine_code both_engines closed_forms random_systems beam implicit_rows operations "
    "functions_of_jax",
    "engine/native/llvm": "machine_code operations functions_of_jax both_engines",
    "engine/native/loops": "both_engines closed_forms random_systems implicit_rows",
    "engine/native/scalars": "operations machine_code functions_of_jax random_systems",
    "engine/native/tracing": "functions_of_jax machine_code both_engines",
    "estimation": "comparison saved_estimates estimate refinement saved_fits rows_and_nodes following bad_input "
    "hard_moments hidden_switches",
    "experiment_design": "information designs design_command",
    "fit": "estimate refinement jumps following finiteness closed_forms starts_benchmark "
    "choice_of_strategies ends_of_searches known_order many_starts hops other_minima guards verdict "
    "logarithmic_times",
    "io": "problem_files saved_estimates first_problem frames files many_logs",
    "io/logs": "text_logs log_formats time_units losses_priors_delays gps_drive dates",
    "io/problem_file": "problem_files first_problem files dates saved_estimates bad_input modes_command jumps",
    "meshes": "both_engines refinement following rows_and_nodes stiffness estimate implicit_rows",
    "models": "vehicles vehicle_mechanics",
    "modes": "found_sequences verdicts_of_searches searches_kept schedules insertion_rates",
    "online": "tracking late_and_missing_samples alarms_and_budgets online_command",
    "optimize": "sqp sqp_kinks sqp_endings qp equalities arrow program simulated_runs multistart many_estimates "
    "chunks choice_of_strategies ends_of_searches known_order many_starts hops other_minima "
    "several_runs",
    "paper": "claims closed_forms",
    "paper_adjoint": "adjoint closed_forms",
    "problem": "bad_input cost_of_data corner_branches corner_derivatives sliding paths_not_followed "
    "friction_and_tanks corners_at_known_times dates numbers_given validation comparison "
    "functions_of_jax finiteness zero_times_nan",
    "problem/corners": "corner_branches corners_at_known_times corner_derivatives sliding friction_and_tanks",
    "problem/validation": "numbers_given bad_input single_precision time_units dates",
    "report": "online_report fit_report figures verdict frames found_sequences verdicts_of_searches "
    "searches_kept validation comparison numbers_given verdicts_of_many",
    "report/html": "html_page",
    "runtime": "ends_of_searches compilations jax_internals progress saved_fits files threads bad_input",
    "strategy": "validation comparison choice_of_strategies ends_of_searches known_order many_starts hops "
    "other_minima beam numbers_given starts_benchmark free_final_time",
    "uncertainty": "covariances identifiability residuals certificate profiles prediction verdict validation "
    "comparison",
}
TESTS = {room: names.split() for room, names in NAMES.items()}
"""What must notice the mistakes of each folder: files of tests, one after the other until something does."""


def draw_mistakes(source: Path) -> Iterator[tuple[str, str, str, str, str]]:
    """Yield folder, name, file, text and text with the mistake of each mistake that the rule draws."""
    for room in (name for name in TESTS if "/" not in name):
        paths = sorted([*source.glob(f"{room}.py"), *(source / room).rglob("*.py")])  # of a module or a folder
        found = [each for path in paths for each in _list_mistakes(path, room)]
        by_hash = {key: mistake for key, *mistake in found}  # one of those that the room has twice
        for key in sorted(by_hash)[:PER_ROOM]:
            name, path, text, mistaken = by_hash[key]
            file = path.relative_to(source)
            folder = next(each.as_posix() for each in (file.with_suffix(""), *file.parents) if each.as_posix() in TESTS)
            yield folder, name, file.as_posix(), text, mistaken


def _list_mistakes(path: Path, room: str) -> Iterator[tuple[str, str, Path, str, str]]:
    """Yield hash, name, file, text and mistaken text of each mistake that could be drawn in a file of a room."""
    text = path.read_text()
    lines, tree = text.splitlines(keepends=True), ast.parse(text)
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line.encode()))
    encoded = text.encode()
    for node in _list_expressions(tree):
        for kind, left, right in _list_operators(node):
            old, new = OPPOSITES[kind]
            begin = starts[left.end_lineno - 1] + left.end_col_offset
            end = starts[right.lineno - 1] + right.col_offset
            between = encoded[begin:end].decode()
            if between.count(old) != 1:
                continue
            mistaken = encoded[:begin].decode() + between.replace(old, new) + encoded[end:].decode()
            line = lines[left.end_lineno - 1].strip()
            what = f"{old} -> {new} in {line} ({left.end_col_offset - node.col_offset})"
            key = hashlib.sha256(f"{room}: {what}".encode()).hexdigest()
            yield key, f"{path.name}: {what}", path, text, mistaken


def _list_expressions(tree: ast.AST) -> Iterator[ast.expr]:
    """Yield all expressions in functions, but for annotations, errors and what is only for type checkers."""
    stack = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    seen: set[ast.AST] = set()
    while stack:
        node = stack.pop()
        if node in seen or isinstance(node, ast.Raise | ast.arguments):
            continue
        seen.add(node)
        if isinstance(node, ast.BinOp | ast.Compare | ast.BoolOp):
            yield node
        children = [node.value] if isinstance(node, ast.AnnAssign) and node.value else list(ast.iter_child_nodes(node))
        stack += [child for child in children if child is not getattr(node, "returns", None)]


def _list_operators(node: ast.expr) -> Iterator[tuple[type[ast.AST], ast.expr, ast.expr]]:
    """Yield the operators of an expression with what is on their left and right."""
    if isinstance(node, ast.BinOp):
        operators, operands = [node.op], [node.left, node.right]
    elif isinstance(node, ast.Compare):
        operators, operands = list(node.ops), [node.left, *node.comparators]
    elif isinstance(node, ast.BoolOp):
        operators, operands = [node.op] * (len(node.values) - 1), node.values
    for operator, left, right in zip(operators, operands, operands[1:], strict=False):
        if type(operator) in OPPOSITES and not any(isinstance(each, ast.JoinedStr) for each in (left, right)):
            yield type(operator), left, right
