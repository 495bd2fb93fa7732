"""Figure 2: the vehicle of equation (18) from above, with its forces."""

from __future__ import annotations

import inspect
from typing import Any

from switchfit.models.skid_steer import SLIP_FORCES, skid_steer
from switchfit.paper.figure_style import BLUE, COLUMN, DARK, LIGHT, RED, new_figure
from switchfit.paper.table_rows import Found, Say
from switchfit.runtime.presentation import Figure as Figure

#: Length and width of a wheel as drawn (m).
WHEEL_SIZE = (0.22, 0.08)

#: Heading as drawn (degrees), and length of the longest force (m).
HEADING, LONGEST_ARROW = 25.0, 0.34


def compute_vehicle(quick: bool, say: Say) -> Found:
    """Return the lengths (m) and the forces in slip (N) of the model."""
    settings = inspect.signature(skid_steer).parameters
    return {name: settings[name].default for name in ("B_l", "B_w", "a", "b")} | {"forces": list(SLIP_FORCES)}


def draw_vehicle(found: Found) -> dict[str, Figure]:
    """Draw the vehicle in slip, turning to the left: wheels with their forces, friction against the lateral speed."""
    from matplotlib.patches import Rectangle
    from matplotlib.transforms import Affine2D

    figure = new_figure(COLUMN, 3.2)
    ax = figure.subplots()
    length, width, a, b = (found[name] for name in ("B_l", "B_w", "a", "b"))
    turn = Affine2D().rotate_deg(HEADING) + ax.transData
    ax.add_patch(Rectangle((-length / 2, -width / 2), length, width, fill=False, edgecolor=DARK, transform=turn))
    places = ((a, -b), (a, b), (-a, b), (-a, -b))  # 1 and 4 on the right, 2 and 3 on the left
    largest = max(found["forces"])
    arrow = {"transform": turn, "length_includes_head": True, "width": 0.008, "head_width": 0.04}
    words: dict[str, Any] = {"fontsize": 6.5, "ha": "center", "transform": turn, "rotation": HEADING}
    for number, ((x, y), force) in enumerate(zip(places, found["forces"], strict=True), start=1):
        corner = x - WHEEL_SIZE[0] / 2, y - WHEEL_SIZE[1] / 2
        ax.add_patch(Rectangle(corner, *WHEEL_SIZE, facecolor=LIGHT, edgecolor=DARK, linewidth=0.7, transform=turn))
        if force > 0:
            ax.arrow(x, y, LONGEST_ARROW * force / largest, 0.0, color=RED, **arrow)
        friction = 0.07 if x > 0 else 0.14  # the center of mass slides outwards: more at the rear
        ax.arrow(x, y, 0.0, -friction if x > 0 else friction, color=BLUE, **arrow)
        below = -0.09 if x > 0 and y > 0 else 0.1
        label = rf"$F_{number}$ = {force:g} N"
        ax.text(x + (0.05 if x > 0 else -0.05), y - below, label, va="center", **words)
    dash: dict[str, Any] = {"color": DARK, "linewidth": 0.6, "linestyle": "--"}
    ax.plot([0.0, 0.75], [0, 0], transform=turn, **dash)
    ax.plot([0, 0.7], [0, 0], **dash)
    ax.text(0.47, 0.08, r"$\theta$", fontsize=9)
    ax.plot(0, 0, "o", color=DARK, markersize=3)
    ax.plot([], [], color=RED, label="drive forces in slip")
    ax.plot([], [], color=BLUE, label="friction against a turn to the left (slip)")
    ax.set(xlim=(-0.7, 0.85), ylim=(-0.75, 0.62), xlabel="X (m)", ylabel="Y (m)")
    ax.set_aspect("equal")
    ax.tick_params(labelsize=7)
    ax.legend(frameon=False, fontsize=6.5, loc="lower right")
    return {"fig2-vehicle": figure}
