"""Services of a process that are independent of problems: files, caches, XLA's flags, progress. Imports no other room."""
