"""Read files: logs, models in Python files, problem files."""
