"""The report of a fit as one HTML file that needs no network: Jinja2's templates, Bokeh's figures.

Both libraries come with the extra ``report`` and are imported when a page is made, not with switchfit. `page` puts the
file together, `figures` draws, `curves` and `sliders` prepare what moves, `inputs` collects what is needed to run the
fit again.
"""
