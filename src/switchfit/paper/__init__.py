"""Every experiment and figure of Section V of the paper, with its numbers compared to ours.

`parts` lists them, `runner` runs them. Imports `experiment_design` and the rooms before it.
"""
