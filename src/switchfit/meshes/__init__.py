"""Meshes: which cells an experiment needs, and which modes take implicit steps on them.

Imports `runtime`, `problem`, `discretization` and `engine`, whose adaptive solve it calls.
"""
