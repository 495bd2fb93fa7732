"""Experiment design: the inputs, sample times and sensors that tell most. It begins in `search`."""
