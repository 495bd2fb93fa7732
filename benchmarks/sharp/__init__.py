"""How often, and how fast, models with corners or sharp changes are fitted: ``python -m benchmarks sharp``."""
