"""One fit: the evaluator, which combines experiments; one run of the optimizer; its result as data.

Imports all rooms before it: `runtime`, `problem`, `discretization`, `engine`, `paper_adjoint`, `optimize`.
"""
