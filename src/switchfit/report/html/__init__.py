"""Results as HTML, in a notebook and as one file."""

from switchfit.report.html import notebook, report_file  # noqa: F401
