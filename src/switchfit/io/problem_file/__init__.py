"""Problem files: a model, its data, guesses and bounds, in TOML."""

from switchfit.io.problem_file.loading import load_problem

__all__ = ["load_problem"]
