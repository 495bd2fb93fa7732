"""Results for people: text, tables and figures. Results do not know this room.

Imports `batch` and the rooms before it.
"""
