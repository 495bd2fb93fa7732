"""Which experiment tells most: inputs, sample times and sensors by which unknowns will be known best.

Imports `online` and the rooms before it.
"""
