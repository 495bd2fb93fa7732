"""Problem files: a model, its data, guesses and bounds, in TOML."""

from switchfit.io.problem_file.loading import load_problem, read_experiments
from switchfit.io.problem_file.tables import OPTIONS, OptionsTable

__all__ = ["OPTIONS", "OptionsTable", "load_problem", "read_experiments"]
