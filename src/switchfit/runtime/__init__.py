"""What a process needs whatever it computes: files, caches, XLA's flags, progress. Imports no other room."""
