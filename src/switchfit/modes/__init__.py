"""Unknown mode sequences: which modes, in which order, how many switches. Imports `batch` and the rooms before it."""
