"""What is estimated: systems, data, experiments, parameters; the user's functions, traced; theta and its constraints.

Imports `runtime` alone. Knows no mesh and no integrator.
"""
