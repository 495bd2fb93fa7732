"""Logs: files of robots and test rigs, read into times and channels with units.

Each format has a module of its own.
"""
