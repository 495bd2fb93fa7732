"""``python -m switchfit``, the same as the command ``switchfit``."""

from __future__ import annotations

from switchfit.cli import main

if __name__ == "__main__":
    main()
