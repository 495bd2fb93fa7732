"""Unknown mode sequences: which modes were active, in which order, and how often they switched.

Imports `batch` and the rooms before it.
"""
