"""Render the sketch of docs/scenarios.md, arms, lanes, sides and distances: `python docs/make_scenario_sketch.py`."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.figures import save_picture
from deepaccident_devkit.synth.roads import Junction, RoadSpec
from deepaccident_devkit.synth.roads.layout import OUTWARD
from deepaccident_devkit.synth.traffic.driving import middle_of, road_crossing

PICTURE = Path(__file__).parent / "images" / "scenario_sketch.png"
SPEC = RoadSpec(lanes=2)
AROUND = 50.0
"""Metres shown to each side of the junction's middle."""
START, PARKED, STEP_OUT = 40.0, 33.5, 27.0
"""Distances to the junction's middle that are shown: of ego, of parked vehicles, of a pedestrian; metres."""
ROAD, STRIP, LINE = "0.82", "0.9", "white"


def main() -> None:
    fig = detached_figure((8, 8))
    ax = fig.subplots()
    render_roads(ax)
    render_lanes(ax)
    render_distances(ax)
    render_sides(ax)
    ax.set(xlim=(-AROUND, AROUND), ylim=(-AROUND, AROUND), xticks=[], yticks=[], aspect="equal")
    save_picture(fig, PICTURE, dpi=100)


def render_roads(ax: Axes) -> None:
    """The two roads with their parking strips, stop lines and names."""
    for half, color in ((SPEC.road_edge, STRIP), (SPEC.lanes_edge, ROAD)):
        for corner, width, height in (
            ((-AROUND, -half), 2 * AROUND, 2 * half),
            ((-half, -AROUND), 2 * half, 2 * AROUND),
        ):
            ax.add_patch(Rectangle(corner, width, height, color=color, linewidth=0))
    near, edge = SPEC.stop_line[0], SPEC.lanes_edge
    for arm, (x, y) in OUTWARD.items():
        out, left = np.array([x, y]), np.array([-y, x])
        for across, style in ((0.0, "-"), (edge / 2, "--"), (-edge / 2, "--")):
            ends = np.stack([near * out + across * left, AROUND * out + across * left])
            ax.plot(*ends.T, style, color=LINE, linewidth=2)
        ax.plot(*np.stack([near * out, near * out + edge * left]).T, color=LINE, linewidth=5)
        ax.text(*(46 * out - 13 * np.abs(left)), arm, fontsize=15, fontweight="bold", ha="center", va="center")
    ax.plot(0, 0, "+", color="black", markersize=14)
    ax.text(1, 1, "middle", fontsize=10)


def render_lanes(ax: Axes) -> None:
    """Each lane's number before the junction, and an arrow in the direction of its traffic."""
    junction = Junction(SPEC)
    for arm in junction.arms:
        for lane in range(SPEC.lanes):
            route = junction.route(arm, "straight", lane)
            x, y, yaw, _ = (float(value) for value in route.path.at(route.stop_s - 4.0))
            ahead = 3.5 * np.array([np.cos(yaw), np.sin(yaw)])
            ax.annotate("", (x + ahead[0], y + ahead[1]), (x, y), arrowprops={"arrowstyle": "-|>", "color": "0.3"})
            ax.text(*((x, y) - ahead / 3), str(lane), fontsize=12, ha="center", va="center")


def render_distances(ax: Axes) -> None:
    """Ego, which turns left from the south, and its start distance along its path."""
    route = Junction(SPEC).route("south", "left", 1)
    along = np.linspace(middle_of(route) - START, middle_of(route) + 30, 200)
    x, y, _, _ = route.path.at(along)
    before = along <= middle_of(route)
    ax.plot(x[before], y[before], color="C0", linewidth=3)
    ax.plot(x[~before], y[~before], color="C0", linewidth=1.5, linestyle=":")
    ax.plot(x[0], y[0], "o", color="C0", markersize=12)
    ax.annotate(
        f"ego: from: south, turn: left, lane: 1,\nstart_distance: {START:g}\n(the solid line, {START:g} m)",
        (x[0], y[0]), (-AROUND + 1, -38), color="C0", fontsize=10, arrowprops={"arrowstyle": "-", "color": "C0"},
    )  # fmt: skip


def render_sides(ax: Axes) -> None:
    """Parked vehicles and a pedestrian on either side of the south arm."""
    for side, sign in (("left", -1), ("right", 1)):
        middle = sign * (SPEC.lanes_edge + SPEC.road_edge) / 2
        ax.add_patch(Rectangle((middle - 0.9, -PARKED - 2.2), 1.8, 4.4, color="C2"))
        label = f"parked: from: south,\nside: {side},\nstart_distance: {PARKED:g}"
        if side == "right":
            ax.text(middle + 3, -PARKED, label, color="C2", fontsize=10, va="center")
        else:
            ax.text(
                middle - 2, -PARKED + 4, f"the same,\nside: {side}", color="C2", fontsize=10, va="center", ha="right"
            )
    path = road_crossing(SPEC, "south", STEP_OUT, "right").xy
    ax.annotate("", path[-1], path[0], arrowprops={"arrowstyle": "-|>", "color": "C3", "linewidth": 2})
    label = f"pedestrian: from: south,\nside: right,\nstart_distance: {STEP_OUT:g}"
    ax.text(path[0, 0] + 1, path[0, 1] + 1, label, color="C3", fontsize=10)


if __name__ == "__main__":
    main()
