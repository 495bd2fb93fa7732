"""Blocks of code on the pages of the documentation, and a folder to run them in."""

import re
import shutil

from support.places import ROOT


def blocks_of(page):
    """(kind, text) of each fenced block."""
    return re.findall(r"^```(\S*)[^\n]*\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)


def copy_examples(folder):
    """Give a folder the examples, as a clone has them."""
    shutil.copytree(ROOT / "examples", folder / "examples", ignore=shutil.ignore_patterns("__pycache__"))
