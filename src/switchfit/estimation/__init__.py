"""`Estimate`, the facade of a fit with its methods, which `estimate` returns, and the comparison of several.

Imports `report` and the rooms before it; no room below imports it.
"""
