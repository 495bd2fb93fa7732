"""Estimation problems: systems, data, experiments, parameters; the user's traced functions; theta and its constraints.

Imports `runtime` alone, and is independent of meshes and integrators.
"""
