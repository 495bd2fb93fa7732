"""Estimation while the system runs, at its task: ``python -m benchmarks online``.

All of it with one simulated vehicle: many short drives for switchfit and other libraries (`side_by_side`), a long drive
with changes and one without any (`long`).
"""
