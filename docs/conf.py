"""Sphinx configuration; `make docs` builds to out/docs."""

import sys
from importlib.metadata import version as installed_version
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import ball_figures  # these stand beside this file
import covid_figures
import heaters_figures
import paper_figures
import sampling_figures
import speed_figures
import starts_figures
import tosses_figures
import uncertainty_figures
import validation_figures

DRAWN_HERE = (
    ball_figures,
    covid_figures,
    heaters_figures,
    paper_figures,
    sampling_figures,
    speed_figures,
    starts_figures,
    tosses_figures,
    uncertainty_figures,
    validation_figures,
)
for pictures in DRAWN_HERE:
    pictures.draw(Path(__file__).parent / "_figures")

project = "switchfit"
author = "switchfit developers"
version = release = installed_version("switchfit")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["_build"]
html_theme = "alabaster"
html_static_path = ["_static"]
html_theme_options = {"description": "When did it switch, and what were the parameters?", "page_width": "1100px"}

autodoc_member_order = "bysource"
autodoc_typehints = "none"
autodoc_default_options = {"members": True}
napoleon_google_docstring = False
napoleon_use_ivar = True
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3  # links to headings, as README pages on the web have them
