"""One fit: the evaluator, which puts experiments together; one run of the optimiser; what it found, as data.

Imports all rooms before it: `runtime`, `problem`, `discretization`, `engine`, `paper_adjoint`, `optimize`.
"""
