"""The checks of a certificate and of derivatives as text."""

from __future__ import annotations

import numpy as np

from switchfit.report.tables import Table, format_table
from switchfit.runtime.presentation import format_text
from switchfit.uncertainty.certificate import Certificate
from switchfit.uncertainty.derivative_check import DerivativeCheck

# --- certificate ------------------------------------------------------------------------------------------------------


@format_text.register(Certificate)
def write_certificate(certificate: Certificate) -> str:
    """Return every check with its number, and the verdict.

    Parameters
    ----------
    certificate : Certificate
    """
    return "\n".join(format_table(*tabulate_certificate(certificate), indent=""))


def tabulate_certificate(certificate: Certificate) -> Table:
    """Return every check with its number, and the verdict, without a header.

    Parameters
    ----------
    certificate : Certificate
    """
    # Constraints and kinks alike take a direction out of those in which the Hessian has to be positive.
    held = "; ".join(map(str, [*certificate.active, *certificate.kinks]))
    failures = "; ".join(map(str, certificate.failures))
    error = f"{certificate.integration_error:.1e} ({certificate.integration_error_of})"
    orders = ", ".join("rounding" if np.isnan(order) else f"{order:.2f}" for order in certificate.taylor_orders)
    rows = [
        ("KKT residual", f"{certificate.optimality:.2e}"),
        ("smallest Hessian eigenvalue, free directions", f"{certificate.smallest_eigenvalue:.4g}"),
        ("  with unknowns scaled to unit curvature", f"{certificate.smallest_scaled_eigenvalue:.4g}"),
        ("  condition number of that", f"{certificate.condition_number:.3g}"),
        ("  worst-determined direction", certificate.worst_direction),
        ("largest integration error, relative", error),
        ("paper's gradient against discretised, relative", _format_gap(certificate.gradient_gap)),
        ("paper's Hessian against discretised, relative", _format_gap(certificate.hessian_gap)),
        (
            "Taylor orders of J, with gradient, with Hessian",
            orders if np.isfinite(certificate.taylor_orders).any() else "not checked",
        ),
        ("active constraints", held or "none"),
        ("verdict", f"FAILED: {failures}" if failures else "passed"),
    ]
    return Table(rows, "<<")


def _format_gap(gap: float) -> str:
    return "not checked" if np.isnan(gap) else f"{gap:.1e}"


# --- derivatives ------------------------------------------------------------------------------------------------------


@format_text.register(DerivativeCheck)
def write_derivative_check(check: DerivativeCheck) -> str:
    """Return the Taylor table, the gaps between the methods, and the verdict.

    Parameters
    ----------
    check : DerivativeCheck
    """
    rows, titles = [], ["h", "J", "order", "+ gradient", "order", "+ Hessian", "order"]
    for k, (h, remainders) in enumerate(zip(check.steps, check.remainders, strict=True)):
        # An order is the slope between two steps: the first one has none. NaN where both remainders are rounding.
        orders = [""] * 3 if k == 0 else ["-" if np.isnan(order) else f"{order:.2f}" for order in check.orders[k - 1]]
        cells = [text for r, order in zip(remainders, orders, strict=True) for text in (f"{r:.2e}", order)]
        rows.append([f"{h:.1e}", *cells])
    lines = [
        "Taylor remainders of J along a random direction",
        "",
        *format_table(rows, ">" * 7, titles),
        "",
        "Paper's equations (6)-(17) against the derivatives of the discretised cost, relative:",
        f"  gradient {_format_gap(check.gradient_gap)}",
        f"  Hessian  {_format_gap(check.hessian_gap)}",
        write_orders(check),
    ]
    return "\n".join(lines)


def write_orders(check: DerivativeCheck) -> str:
    """Return the observed orders of the Taylor remainders and the verdict, in a line.

    Parameters
    ----------
    check : DerivativeCheck
    """
    verdict = f"FAILED: {'; '.join(map(str, check.failures))}" if check.failures else "passed"
    # Without remainders there are no orders, and nothing that was expected of them.
    if any(issue.kind == "cost not finite" for issue in check.failures):
        return f"No orders were observed: {verdict}."
    observed = check.observed_orders
    orders = ", ".join("rounding only" if np.isnan(order) else f"{order:.2f}" for order in observed)
    return f"Observed orders {orders} (1, 2, 3 expected): {verdict}."
