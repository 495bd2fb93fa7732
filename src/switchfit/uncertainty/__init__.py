"""What the data say about a fit, beside its numbers: profiles, predictions, identifiability, residuals, certificate.

Imports `fit` and the rooms before it.
"""
