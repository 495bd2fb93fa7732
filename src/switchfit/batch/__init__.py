"""Thousands of fits of one model: Monte Carlo, multistart, many logs."""
