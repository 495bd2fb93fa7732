"""Benchmarks of switchfit: ``python -m benchmarks``. What is compared with what: README.md beside this file."""
