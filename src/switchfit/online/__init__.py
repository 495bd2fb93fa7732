"""Estimation while the system runs: one sample at a time, by the hypotheses of the beam."""
