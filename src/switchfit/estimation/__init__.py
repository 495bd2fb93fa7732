"""`estimate` and the `Estimate` that it returns, with everything that can be asked of it.

Imports `uncertainty` and the rooms before it.
"""
