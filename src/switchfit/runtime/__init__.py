"""Services that do not depend on the problem: files, caches, XLA's flags, progress. Imports no other room."""
