"""Sphinx configuration; `make docs` builds to out/docs. Neither the build nor the pages need a network."""

import importlib
import sys
from importlib.metadata import version as installed_version
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import command_pages  # the modules beside this file are imported from here on
import key_pages
from sphinx.application import Sphinx

HERE = Path(__file__).parent
SOURCES = [*HERE.glob("measured/*"), *HERE.parent.glob("src/**/*.py")]
SOURCES += [*HERE.parent.glob("examples/**/*.py"), *HERE.parent.glob("examples/**/*.csv")]
"""What figures are made from: the library, the examples, stored results."""


def draw_figures(folder: Path) -> None:
    """Draw the figures of which the sources or the script have changed since they were drawn."""
    changed = max(path.stat().st_mtime for path in SOURCES)
    for script in sorted(HERE.glob("*_figures.py")):
        stamp = folder / f".{script.stem}"
        if not stamp.exists() or stamp.stat().st_mtime < max(changed, script.stat().st_mtime):
            importlib.import_module(script.stem).draw(folder)
            stamp.touch()


draw_figures(HERE / "_figures")
command_pages.write(HERE / "_generated")
key_pages.write(HERE / "_generated")

project = "switchfit"
author = "switchfit developers"
project_copyright = "switchfit developers, BSD-3-Clause"
version = release = installed_version("switchfit")

extensions = [
    "mathml",  # beside this file
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
INCLUDED = [f"measured/{table.name}" for table in HERE.glob("measured/*.md") if table.stem != "speed"]
"""Tables that other pages include; they are no pages themselves."""
exclude_patterns = ["_build", "_generated", *INCLUDED]
templates_path = ["_templates"]

html_theme = "furo"
html_title = f"switchfit {release}"
html_static_path = ["_static"]
html_css_files = ["custom.css"]
html_theme_options = {"navigation_with_keys": True, "top_of_page_buttons": []}
html_copy_source = False
html_show_sourcelink = False
pygments_style = "friendly"
pygments_dark_style = "monokai"
copybutton_prompt_text = r"\$ |>>> |\.\.\. "
copybutton_prompt_is_regexp = True

add_module_names = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"
autodoc_default_options = {"members": True}
autosummary_generate = True
autosummary_imported_members = True
napoleon_google_docstring = False
napoleon_use_ivar = True
suppress_warnings = ["ref.python"]  # words in types of docstrings, such as "times", of which several classes have one
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3  # links to headings, as README pages on the web have them


def keep_first_line(app: Sphinx, what: str, name: str, item: object, options: object, lines: list[str]) -> None:
    """Let the docstring of a property begin with an empty line: napoleon reads ``a: b`` in its first line as a type."""
    if what == "property":
        lines.insert(0, "")


def setup(app: Sphinx) -> None:
    """Connect what runs before napoleon, whose priority is 500."""
    app.connect("autodoc-process-docstring", keep_first_line, priority=400)
