"""Thousands of fits of one model: simulated data, many starts, resampled data, many logs.

Imports `strategy` and the rooms before it.
"""
