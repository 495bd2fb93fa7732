"""Thousands of fits of one model: simulated data, many starts, resampled data, many logs.

Imports `estimation` and the rooms before it.
"""
