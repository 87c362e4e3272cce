"""An accident over its normal twin: from above where they part and at the impact, and the colliders' speeds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray, IntArray
from deepaccident_devkit.geometry import Boxes, quaternions
from deepaccident_devkit.render.axes import axis_words, figure_or_new, with_light_grid
from deepaccident_devkit.render.boxes import draw_boxes_from_above
from deepaccident_devkit.render.chips import SMALLEST_TEXT, keep_free, place_chips
from deepaccident_devkit.render.colors import MUTED_COLOR, OWN_COLOR, SERIES_COLORS
from deepaccident_devkit.render.legends import draw_legend
from deepaccident_devkit.render.roles import actor_color
from deepaccident_devkit.render.styles import has_tokens, in_own_settings
from deepaccident_devkit.safety import TwinDiff
from deepaccident_devkit.taxonomy import CATEGORIES, frame_timestamp, short_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TWINS_SIZE: Final = (10.7, 8.6)
"""Inches: the width of a page of A4 in landscape."""
_DASHED: Final = (0, (3, 2))
_LEAST, _MOST = 15.0, 60.0
"""Metres that are shown to each side of the middle of the colliders' places, at least and at most."""
_MARGIN: Final = 6.0
"""Metres around them."""


@in_own_settings
def render_twins(diff: TwinDiff, *, fig: Figure | None = None) -> Figure:
    """Render an accident (filled boxes, solid lines) over its twin (dashed).

    Args:
        diff: of `twin_diff`.
        fig: an empty figure to render on; a new one if None.

    Returns:
        The figure: both from above, in world, at the frame at which they part (if they do not, at the first one) and
        at the impact; below, the colliders' speeds over time.
    """
    fig = figure_or_new(fig, TWINS_SIZE)
    axes = fig.subplot_mosaic([["parting", "impact"], ["speeds", "speeds"]], height_ratios=(2.2, 1))
    parting, impact = diff.parting_frame, diff.num_frames[0]
    _draw_from_above(diff, parting or 1, axes["parting"])
    _draw_from_above(diff, impact, axes["impact"])
    when = f"they part: {frame_timestamp(parting):.1f} s" if parting else "they never part: 0.0 s"
    axes["parting"].set_title(when, fontsize=SMALLEST_TEXT)
    axes["impact"].set_title(f"impact: {frame_timestamp(impact):.1f} s", fontsize=SMALLEST_TEXT)
    _draw_speeds(diff, axes["speeds"])
    words = "filled and solid: the accident; dashed: its normal twin"
    fig.suptitle(f"{diff.accident}\n{words}" if has_tokens() else words, fontsize=SMALLEST_TEXT)
    handles, names = axes["speeds"].get_legend_handles_labels()
    draw_legend(fig, handles, columns=len(names), loc="outside lower center")
    return fig


def _draw_from_above(diff: TwinDiff, frame: int, ax: Axes) -> None:
    """All actors of a frame (number from 1) of both recordings, and where the colliders came from."""
    for at in (1, 0):
        rows = np.flatnonzero(~np.isnan(_poses_at(diff, at, frame)[:, 0]))
        colors = [_color(diff, row) for row in rows.tolist()]
        how = {"linestyle": _DASHED} if at else {}
        draw_boxes_from_above(_boxes(diff, at, frame, rows), ax, colors, fill=0.0 if at else 0.35, **how)
        for row in diff.pair:
            path = diff.poses[at, row, :frame, :2]
            ax.plot(*path.T, color=_color(diff, row), linewidth=1, linestyle=_DASHED if at else "-", zorder=1)
    _aim(diff, frame, ax)
    xlabel, ylabel = axis_words("world")
    ax.set(aspect="equal", xlabel=xlabel, ylabel=ylabel)
    with_light_grid(ax, "both")
    for at in (0, 1):
        places = {f"{_name(diff, row)}{' (twin)' * at}": _poses_at(diff, at, frame)[row, :2] for row in diff.pair}
        there = {words: place.tolist() for words, place in places.items() if not np.isnan(place[0])}
        place_chips(ax, there.items())
        keep_free(ax, [[place] for place in there.values()])


def _aim(diff: TwinDiff, frame: int, ax: Axes) -> None:
    """Show the colliders of both recordings."""
    places = np.concatenate([_poses_at(diff, at, frame)[list(diff.pair), :2] for at in (0, 1)])
    places = places[~np.isnan(places[:, 0])]
    if not len(places):
        return
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    reach = float(np.clip(np.abs(places - middle).max() + _MARGIN, _LEAST, _MOST))
    ax.set(xlim=(middle[0] - reach, middle[0] + reach), ylim=(middle[1] - reach, middle[1] + reach))


def _draw_speeds(diff: TwinDiff, ax: Axes) -> None:
    time = np.array([frame_timestamp(index + 1) for index in range(diff.speeds.shape[-1])])
    for place, row in enumerate(diff.pair):
        for at in (0, 1):
            words = f"{_name(diff, row)}{', in the twin' * at}"
            ax.plot(time, diff.speeds[at, row], color=SERIES_COLORS[2 * place], linestyle=("-", "--")[at], label=words)
    marks = [("impact", diff.num_frames[0]), *([("they part", diff.parting_frame)] if diff.parting_frame else [])]
    for words, frame in marks:
        ax.axvline(frame_timestamp(frame), color=MUTED_COLOR, linewidth=0.8)
        ax.annotate(
            words,
            (frame_timestamp(frame), 1.01),
            xycoords=("data", "axes fraction"),
            ha="center",
            fontsize=SMALLEST_TEXT,
            color=OWN_COLOR,
        )
    ax.set(xlabel="time (s)", ylabel="speed (m/s)", ylim=(0, None))
    with_light_grid(ax, "both")


def _boxes(diff: TwinDiff, at: int, frame: int, rows: IntArray) -> Boxes:
    """The boxes of some actors at a frame, at height 0, in the accident (0) or in the twin (1)."""
    poses, count = _poses_at(diff, at, frame)[rows], len(rows)
    return Boxes(
        frame="world",
        center=np.column_stack([poses[:, :2], np.zeros(count)]),
        size=diff.sizes[at, rows],
        rotation=quaternions.from_yaw(poses[:, 2]),
        velocity=np.full((count, 3), np.nan),
        category=np.array([CATEGORIES.index(diff.categories[row]) for row in rows.tolist()], dtype=np.int8),
        actor_id=diff.actor_ids[rows, at],
        num_lidar_pts=np.zeros(count, dtype=np.int64),
        camera_visible=np.zeros(count, dtype=bool),
        row=np.arange(count),
    )


def _poses_at(diff: TwinDiff, at: int, frame: int) -> FloatArray:
    poses: FloatArray = diff.poses[at, :, frame - 1]
    return poses


def _color(diff: TwinDiff, row: int) -> str:
    return actor_color(diff.categories[row], diff.agents[row], collides=row in diff.pair)


def _name(diff: TwinDiff, row: int) -> str:
    agent = diff.agents[row]
    return f"{diff.categories[row]} {diff.actor_ids[row, 0]}" if agent is None else short_name(agent)
