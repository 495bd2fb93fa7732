"""Files: tables of measurements, models in Python files, problem files, saved estimates."""
