"""The picture of the page on sampling, from the samples that the code on it draws."""

from __future__ import annotations

import warnings
from pathlib import Path

from page_blocks import run_blocks


def draw(folder: Path) -> None:
    """Write posterior.svg."""
    folder.mkdir(exist_ok=True)
    names = run_blocks("sampling.md")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of ArviZ with newer versions of matplotlib
        axes = names["arviz"].plot_pair(
            names["chains"], var_names=["tau_2", "mu"], kind="kde", marginals=True, figsize=(6.0, 5.0), textsize=9
        )
    axes.ravel()[0].figure.savefig(folder / "posterior.svg")
