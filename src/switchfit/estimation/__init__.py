"""`estimate`, and the `Estimate` that it returns, with its methods for uncertainty, prediction, plots and files.

Imports `uncertainty` and the rooms before it.
"""
