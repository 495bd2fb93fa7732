"""Read files: tables of measurements, models in Python files, problem files."""
