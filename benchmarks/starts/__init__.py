"""From which starts is the right answer found? ``python -m benchmarks starts``: problems, methods, seeded starts.

`case` says what a problem is, `problems` lists them and where they are, `methods` what fits them,
`study` runs all starts and writes their outcomes, `table` counts.
"""
