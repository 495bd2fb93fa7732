"""Uncertainty and checks of a fit: profiles, predictions, identifiability, residuals, certificate, verdict.

Imports `fit` and the rooms before it.
"""
