"""The two that collide, at a moment: in the camera of an agent, and from above around the place of contact."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.render.axes import Layer
from deepaccident_devkit.render.best_view import BestView, best_view, crop_about
from deepaccident_devkit.render.boxes import (
    bounds_in_image,
    draw_actors_from_above,
    draw_boxes_in_image,
    draw_trails,
)
from deepaccident_devkit.render.camera import CAMERA_LAYERS, draw_camera
from deepaccident_devkit.render.chips import SMALLEST_TEXT, keep_free, place_chips
from deepaccident_devkit.render.colors import CASING_COLOR, COLLIDER_COLOR, GRID_COLOR
from deepaccident_devkit.render.ground import draw_underlay
from deepaccident_devkit.render.legends import is_there
from deepaccident_devkit.render.roles import actor_tags, camera_name, role_colors
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import BEV_CAMERA, CAMERAS, FRAME_PERIOD
from deepaccident_devkit.v2x import Contact
from deepaccident_devkit.v2x.agents import agents_of
from deepaccident_devkit.v2x.poses import camera_of
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
_CROSS: Final = 9.0
"""Points: the size of the cross at the place of contact."""
_EDGE: Final = 0.01
"""Share of a panel's width and height that the places of tags keep to its edges."""
_FREE: Final = 22.0
"""Points, about, at the top of an image in which tags may cover a car: it may fill the image."""
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
    hidden = both.select(~np.isin(both.actor_id, dataset.boxes(sample, visible="camera").actor_id))
    draw_boxes_in_image(hidden, lens, ax, [COLLIDER_COLOR] * len(hidden), linestyle=_HIDDEN)
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
    _write_tags_from_above(pair, both, ax)  # before the ids, which have what room is left
    draw_actors_from_above(boxes, ax, role_colors(dataset, sample, boxes), layers)
    ax.plot(x, y, "x", color="black", markersize=_CROSS, markeredgewidth=1.8, zorder=5)
    keep_free(ax, [[place]], margin=(-_CROSS / 2, -_CROSS / 2, _CROSS / 2, _CROSS / 2))
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

    metres = 5.0 if reach < 1.25 * _LEAST else 10.0
    if grid:
        ax.grid(color=GRID_COLOR, linewidth=0.4)
        ax.set_axisbelow(True)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MultipleLocator(metres))
    ax.tick_params(labelbottom=False, labelleft=False, length=0)
    left, low = (each + 0.1 * reach for each in ax.viewLim.min)
    ax.plot([left, left + metres], [low, low], color="black", linewidth=2)
    paper = {"facecolor": CASING_COLOR, "edgecolor": "none", "alpha": 0.7, "pad": 0.5}
    ax.text(left, low + 0.06 * reach, f"{metres:.0f} m", fontsize=SMALLEST_TEXT, va="bottom", zorder=6, bbox=paper)
    keep_free(ax, [[(left, low), (left + metres, low)]], margin=(-2, -2, 2, 2 * SMALLEST_TEXT))


def _write_tags_in_image(pair: Pair, actors: list[int], bounds: FloatArray, ax: Axes) -> None:
    """Write tags above what the panel shows of boxes with bounds (N, 4), pixels; of two, at their outer sides."""
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    cars = bounds.reshape(-1, 2, 2).clip((left, top), (right, bottom))
    shown = np.flatnonzero((cars[:, 1] > cars[:, 0]).all(axis=1))
    shown = shown[np.argsort(cars[shown, :, 0].mean(axis=1))]
    cars = cars[shown]
    places = np.column_stack([cars[..., 0].mean(axis=1), cars[:, 0, 1]])
    if len(cars) > 1:
        places[:, 0] = cars[0, 0, 0], cars[1, 1, 0]
    free = top + (bottom - top) * min(0.5, _FREE * ax.figure.dpi / 72 / ax.bbox.height)
    places[places[:, 1] < free, 1] = top
    cars[..., 1] = cars[..., 1].clip(free)
    _write_tags([pair.tags[actors[row]] for row in shown.tolist()], places, ax)
    keep_free(ax, cars)


def _write_tags_from_above(pair: Pair, both: Boxes, ax: Axes) -> None:
    """Write tags beside boxes of the pair, each at the end that is away from the other."""
    middle = both.center[:, :2].mean(axis=0) if len(both) > 1 else pair.contact.point[:2]
    away = both.center[:, :2] - middle
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    ends = both.bottom_corners()[..., :2] - both.center[:, None, :2]
    places = both.center[:, :2] + away * (ends @ away[..., None]).max(axis=1)
    _write_tags([pair.tags[actor] for actor in both.actor_id.tolist()], places, ax)


def _write_tags(tags: list[str], places: FloatArray, ax: Axes) -> None:
    """Write tags near places (N, 2) or, if these are not in the panel, at its edge."""
    low, high = np.array(ax.viewLim.min), np.array(ax.viewLim.max)
    edge = _EDGE * (high - low)
    places = places.clip(low + edge, high - edge)
    place_chips(ax, zip(tags, places, strict=True), colors=[COLLIDER_COLOR] * len(tags))
