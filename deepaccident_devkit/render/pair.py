"""The two that collide, at a moment: in the camera of an agent, and from above around the place of contact."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.render.best_view import BestView, best_view, crop_about
from deepaccident_devkit.render.bev import draw_underlay
from deepaccident_devkit.render.boxes import (
    bounds_in_image,
    draw_actors_from_above,
    draw_boxes_in_image,
)
from deepaccident_devkit.render.camera import CAMERA_LAYERS, draw_camera
from deepaccident_devkit.render.chips import SMALLEST_TEXT
from deepaccident_devkit.render.colors import COLLIDER_COLOR, GRID_COLOR
from deepaccident_devkit.render.layers import Layer
from deepaccident_devkit.render.missing import is_there
from deepaccident_devkit.render.roles import actor_tags, camera_name, role_colors
from deepaccident_devkit.render.trails import draw_trails
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import BEV_CAMERA, CAMERAS, FRAME_PERIOD
from deepaccident_devkit.v2x import Contact
from deepaccident_devkit.v2x.configurations import agents_of
from deepaccident_devkit.v2x.projection import camera_of
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PAIR_LAYERS: Final[tuple[Layer, ...]] = (*CAMERA_LAYERS, "bev", "trajectories", "grid")
_REMEMBERED: Final = 10
"""Frames for which the last camera that saw the pair is kept."""
_LEAST, _MOST = 9.0, 24.0
"""Metres around the place of contact that are shown, at least and at most."""
_MARGIN: Final = 2.5
"""Metres around the pair."""
_PAST: Final = 3.0
"""Seconds of the paths that led to the contact."""
_LEAST_CROP: Final = 0.4
"""Share of an image's width that is shown at least: who looks must still see where it is."""
_EDGE: Final = 0.1
"""Share of a panel's width and height that tags keep to its edges."""
_HIDDEN: Final = (0, (3, 2))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pair:
    """Two actors that collide.

    Attributes:
        dataset: the release.
        scenario: token.
        contact: how they touch.
        tracks: where all actors of the scenario are.
        tags: actor id → a short name.
    """

    dataset: Dataset
    scenario: str
    contact: Contact
    tracks: ScenarioTracks
    tags: dict[int, str]

    @classmethod
    def of(cls, dataset: Dataset, contact: Contact) -> Pair:
        """The pair of a contact."""
        scenario = contact.frame.rsplit("/", 1)[0]
        tracks = scenario_tracks(dataset, scenario)
        return cls(
            dataset=dataset, scenario=scenario, contact=contact, tracks=tracks, tags=actor_tags(dataset, contact)
        )

    def at(self, index: int, seen_by: str | None = None) -> Boxes:
        """Their boxes in world in a frame (number from 1), as far as they exist; without the agent that sees them."""
        there = self.tracks.at(index)
        own = None if seen_by is None else self.dataset.agent.get(f"{self.scenario}/{seen_by}")["actor_id"]
        ids = [actor for actor in self.contact.actor_ids if actor != own]
        return there.select(np.isin(there.actor_id, ids))

    def view(self, agent: str, index: int) -> tuple[str, BestView | None, int | None]:
        """The camera of an agent that shows the pair best in a frame, its view, and when it last had the pair.

        Cameras whose images are there come first. If none has the pair in its image, it is the last one that had, and
        without such a one the front camera; then there is no view.
        """
        sample = sample_token(self.scenario, agent, index)
        there = [channel for channel in CAMERAS if is_there(self.dataset, f"{sample}/{channel}")] or CAMERAS
        for earlier in range(index, max(0, index - _REMEMBERED), -1):
            then = sample_token(self.scenario, agent, earlier)
            view = best_view(self.dataset, [then], self.at(earlier, agent), there)
            if view is not None:
                return view.camera.rsplit("/", 1)[1], view if earlier == index else None, earlier
        return there[0], None, None


def draw_pair_in_camera(pair: Pair, agent: str, index: int, layers: Collection[Layer], ax: Axes) -> str:
    """Render the part of an agent's image that has the pair, with tags; dashed if no camera of the agent sees them.

    Args:
        pair: who collides.
        agent: whose camera, as `Pair.view` chooses it.
        index: number of the frame, from 1.
        layers: those that cameras have.
        ax: axes to render on.

    Returns:
        The short name of the camera, and how long ago it saw the pair if it does not now.
    """
    dataset, sample = pair.dataset, sample_token(pair.scenario, agent, index)
    channel, view, last = pair.view(agent, index)
    name = camera_name(channel)
    camera = dataset.get("sample_data", f"{sample}/{channel}")
    draw_camera(dataset, camera, {*layers}.intersection(CAMERA_LAYERS), ax)
    ax.set_title("")
    if view is None:
        return name if last is None else f"{name}:\nseen {(index - last) * FRAME_PERIOD:.1f} s ago"
    lens = camera_of(dataset, camera)
    left, top, right, bottom = crop_about(view.bounds, width=lens.width, height=lens.height, share=_LEAST_CROP)
    ax.set(xlim=(left, right), ylim=(bottom, top))
    if "boxes" not in layers:
        return name
    both = pair.at(index, agent).transform(dataset.world_from(sample, channel).inverse(), channel)
    seen = np.isin(both.actor_id, dataset.boxes(sample, visible="camera").actor_id)
    for rows, how in ((seen, "-"), (~seen, _HIDDEN)):
        red = [COLLIDER_COLOR] * int(rows.sum())
        draw_boxes_in_image(both.select(rows), lens, ax, red, linewidths=1.8, linestyle=how)
    _write_tags_in_image(pair, both.actor_id.tolist(), bounds_in_image(both, lens), ax)
    return name


def draw_pair_from_above(pair: Pair, index: int, layers: Collection[Layer], ax: Axes) -> None:
    """Render a frame (number from 1) around the place of contact, in world, as near as the pair allows.

    Args:
        pair: who collides.
        index: number of the frame, from 1.
        layers: `bev` (the road), `boxes`, `velocities`, `ids`, `trajectories` (of the pair, up to the contact), `grid`.
        ax: axes to render on; its title is the pair's speeds.
    """
    dataset, contact = pair.dataset, pair.contact
    sample = dataset.get("sample", sample_token(pair.scenario, agents_of(dataset, pair.scenario)[0], index))
    boxes, both = pair.tracks.at(index), pair.at(index)
    place = contact.point[:2]
    reach = _MARGIN + float(np.abs(both.bottom_corners()[..., :2] - place).max(initial=0.0))
    reach = min(max(reach, _LEAST), _MOST)
    x, y = place.tolist()
    ax.set(xlim=(x - reach, x + reach), ylim=(y - reach, y + reach), aspect="equal")
    if "bev" in layers:
        _draw_road(pair, index, reach, ax)
    if "trajectories" in layers:
        seconds, red = (_PAST, sample["time_to_impact"] or 0.0), [COLLIDER_COLOR] * len(both)
        draw_trails(dataset, sample, both, red, target_from_world=SE3.identity(), seconds=seconds, ax=ax)
    draw_actors_from_above(boxes, ax, role_colors(dataset, sample, boxes), layers)
    ax.plot(x, y, "x", color="black", markersize=9, markeredgewidth=1.8, zorder=5)
    _write_tags_from_above(pair, both, reach, ax)
    _draw_scale(reach, ax, grid="grid" in layers)
    speeds = [
        f"{pair.tags[actor]} {number_words(float(np.linalg.norm(velocity)))}"
        for actor, velocity in zip(both.actor_id.tolist(), both.velocity, strict=True)
    ]
    ax.set_title(f"{', '.join(speeds)} m/s", fontsize=SMALLEST_TEXT)


def number_words(value: float) -> str:
    """A number with one digit, or `unknown`."""
    return f"{value:.1f}" if np.isfinite(value) else "unknown"


def _draw_road(pair: Pair, index: int, reach: float, ax: Axes) -> None:
    """Render the ground from the BEV camera that is nearest to the contact; nothing if there is no file."""
    dataset, place = pair.dataset, pair.contact.point[:2]
    samples = [sample_token(pair.scenario, agent, index) for agent in agents_of(dataset, pair.scenario)]
    there = [sample for sample in samples if is_there(dataset, f"{sample}/{BEV_CAMERA}")]
    poses = [dataset.world_from(sample, "ego") for sample in there]
    away = [float(np.abs(pose.translation[:2] - place).max()) for pose in poses]
    if there:
        best = int(np.argmin(away))
        image = dataset.load_bev(there[best])
        draw_underlay(image, ax, target_from_ego=poses[best], view_range=reach + away[best])


def _draw_scale(reach: float, ax: Axes, *, grid: bool) -> None:
    """Render a bar of 5 or 10 m, and cells of that size, in place of numbers at the axes."""
    from matplotlib.ticker import MultipleLocator

    metres = 5.0 if reach < _LEAST + _EDGE * _MOST else 10.0
    if grid:
        ax.grid(color=GRID_COLOR, linewidth=0.4)
        ax.set_axisbelow(True)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MultipleLocator(metres))
    ax.tick_params(labelbottom=False, labelleft=False, length=0)
    ax.plot([0.05, 0.05 + metres / (2 * reach)], [0.05] * 2, color="black", linewidth=2, transform=ax.transAxes)
    ax.text(0.05, 0.07, f"{metres:.0f} m", fontsize=SMALLEST_TEXT, va="bottom", transform=ax.transAxes, zorder=6)


def _write_tags_in_image(pair: Pair, actors: list[int], bounds: FloatArray, ax: Axes) -> None:
    """Write tags above what is in the panel of boxes' bounds (N, 4), pixels; of two, towards the outer sides."""
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    low, high = bounds[:, :2].clip((left, top), (right, bottom)), bounds[:, 2:].clip((left, top), (right, bottom))
    shown = np.flatnonzero((high > low).all(axis=1))
    shown = shown[np.argsort((low + high)[shown, 0])]
    places = (low + high)[shown, 0] / 2
    margin = _EDGE * (right - left)
    if len(shown) > 1:
        places = np.array([low[shown[0], 0], high[shown[1], 0]])
        middle, half = places.mean(), max(float(np.ptp(places)) / 2, margin)
        middle = np.clip(middle, left + margin + half, right - margin - half)
        places = np.array([middle - half, middle + half])
    for row, u in zip(shown.tolist(), places.clip(left + margin, right - margin).tolist(), strict=True):
        near_top = low[row, 1] < top + 2.5 * _EDGE * (bottom - top)
        v, side = (top, "top") if near_top else (float(low[row, 1]), "bottom")
        _write_tag(pair.tags[actors[row]], (u, v), (0, -5 if near_top else 5), ax, va=side)


def _write_tags_from_above(pair: Pair, both: Boxes, reach: float, ax: Axes) -> None:
    """Write tags beside boxes of the pair, each on the side that is away from the other."""
    middle = both.center[:, :2].mean(axis=0) if len(both) > 1 else pair.contact.point[:2]
    for row, actor in enumerate(both.actor_id.tolist()):
        away = both.center[row, :2] - middle
        away = away / np.linalg.norm(away) if np.linalg.norm(away) > 0 else np.array([0.0, 1.0])
        corners = both.bottom_corners()[row, :, :2] - both.center[row, :2]
        place = both.center[row, :2] + away * float((corners @ away).max())
        low, high = pair.contact.point[:2] - reach * (1 - 2 * _EDGE), pair.contact.point[:2] + reach * (1 - 2 * _EDGE)
        low[1] += 2 * _EDGE * reach  # above the scale
        place = place.clip(low, high)
        _write_tag(pair.tags[actor], (float(place[0]), float(place[1])), (10 * away[0], 10 * away[1]), ax, va="center")


def _write_tag(words: str, place: tuple[float, float], offset: tuple[float, float], ax: Axes, *, va: str) -> None:
    chip = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": COLLIDER_COLOR, "linewidth": 0.8}
    style: dict[str, Any] = {"ha": "center", "va": va, "fontsize": SMALLEST_TEXT, "fontweight": "bold", "zorder": 7}
    ax.annotate(words, place, offset, textcoords="offset points", color="black", bbox=chip, gid="tag", **style)
