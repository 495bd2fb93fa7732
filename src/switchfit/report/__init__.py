"""What a fit looks like: `text.report` for the terminal, `plot` for figures. Both know a `Fit` and nothing else."""
