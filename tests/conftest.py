"""Settings for all tests: the same examples in every run, and a compilation cache of the tests' own."""

from hypothesis import settings

settings.register_profile("switchfit", derandomize=True, deadline=None)
settings.load_profile("switchfit")
