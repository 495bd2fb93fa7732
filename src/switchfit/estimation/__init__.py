"""`Estimate`, the facade of a fit with its methods, and the single fit from one start that returns it.

Imports `uncertainty` and the rooms before it.
"""
