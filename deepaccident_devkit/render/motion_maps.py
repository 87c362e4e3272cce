"""`MotionMaps`: labels and predictions of motion in one format, and the rendering of its cells."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

import numpy as np

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.instances import instance_paths
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import to_orientation
from deepaccident_devkit.motion import (
    OWN_BOX_ID,
    MotionHeads,
    MotionLabels,
    PostProcessing,
    predict_instances,
)
from deepaccident_devkit.render.captions import hue_meanings
from deepaccident_devkit.render.chips import place_chips
from deepaccident_devkit.render.figures import Layer, label_axes, with_light_grid, write_in_middle
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    BEYOND_COLOR,
    CENTERNESS_COLORMAP,
    COLLIDER_COLOR,
    DIRECTION_COLORS,
    INSTANCE_COLORS,
    OWN_COLOR,
)
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, FrozenArrays
from deepaccident_devkit.taxonomy import FRAME_PERIOD, OWN_ACTOR_ID

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

DrawnMap = Literal["instance", "centerness", "offset", "flow"]
DRAWN_MAPS: Final[tuple[DrawnMap, ...]] = get_args(DrawnMap)
# Opacity of the last frame of a trail; the current frame has the opacity 1.
MIN_TRAIL_OPACITY: Final = 0.22
# Width of the edge of the ego's own box, in points.
_OWN_EDGE_WIDTH_PT = 1.0
# Grey of cells that do not move.
_STILL_GREY = 0.92


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionMaps(FrozenArrays):
    """Motion over T frames, ready to be drawn; arrays are read-only.

    Rows of cells run along y (left), columns along x (forward).

    Attributes:
        grid: Cells, in the devkit's orientation.
        step: Seconds from frame to frame.
        at_present: Whether all frames are in the ego frame at t = 0; otherwise each is in the ego
            frame of its own time.
        valid: Whether each frame exists, (T,) bool.
        instance: Instance ids from 1, shape (T, H, W); 0 for other cells and in missing frames.
        colors: RGB colour of each id, shape (1 + ids, 3); white for 0.
        own: Id of the ego's own box; −1 if unknown.
        centerness: Centerness in [0, 1], shape (T, H, W); None if only instances are known.
        offset: Vectors in cells (left, forward), shape (T, 2, H, W), NaN outside instances; None
            if only instances are known.
        flow: Vectors in cells, shape (T, 2, H, W), like `offset`; also NaN where the flow is
            unknown.
    """

    grid: BevGrid
    step: float
    at_present: bool
    valid: BoolArray
    instance: AnyArray
    colors: FloatArray
    own: int = -1
    centerness: AnyArray | None = None
    offset: AnyArray | None = None
    flow: AnyArray | None = None

    @property
    def names(self) -> tuple[DrawnMap, ...]:
        """Names of the maps that are not None."""
        names = []
        for name in DRAWN_MAPS:
            if getattr(self, name) is not None:
                names.append(name)
        return tuple(names)

    def vectors(self, name: DrawnMap) -> AnyArray:
        """Return `offset` or `flow`, shape (T, 2, H, W); raise ChoiceError if it is None."""
        maps = getattr(self, name)
        if maps is None:
            raise ChoiceError(
                f"map: this prediction has only {', '.join(self.names)}, not {name}; "
                "give heads for it"
            )
        return np.asarray(maps)

    def longest(self, name: DrawnMap) -> float:
        """Return the length of a map's longest vector over all frames, in cells, at least 1.

        Maps without vectors have length 1.
        """
        if name not in ("offset", "flow"):
            return 1.0
        length = np.linalg.norm(self.vectors(name), axis=1)
        longest = float(np.nan_to_num(length).max(initial=0))
        return max(1.0, longest)

    def paths(self) -> dict[int, FloatArray]:
        """Return the paths of the first frame's instances, by id.

        Each path has shape (n, 2): x forward and y left, metres.
        """
        if not self.valid[0]:
            return {}
        return instance_paths(self.instance[self.valid], self.grid)


def maps_of_labels(
    labels: MotionLabels, marked: Collection[int] = (), agents: Mapping[int, str] | None = None
) -> MotionMaps:
    """Convert labels to `MotionMaps`.

    Actors in `marked` (label ids) are red. Vehicles in `agents` (agent by label id) have their
    agents' hues.
    """
    source = labels.config.grid.orientation
    ignore = labels.config.ignore_index
    valid = labels.label_valid

    def oriented(name: str, *, vectors: bool = False) -> AnyArray:
        return to_orientation(
            getattr(labels, name), vectors=vectors, source=source, target="devkit", ignore=ignore
        )

    instance = np.where(valid[:, None, None], oriented("instance"), 0)
    occupied = instance[:, None] > 0
    offset = oriented("offset", vectors=True)
    flow = oriented("flow", vectors=True)
    has_offset = occupied & (offset != ignore).any(axis=1, keepdims=True)
    has_flow = occupied & (flow != ignore).any(axis=1, keepdims=True)
    return MotionMaps(
        grid=labels.config.grid.with_orientation("devkit"),
        step=labels.config.step * FRAME_PERIOD,
        at_present=labels.at_present,
        valid=valid,
        instance=instance,
        colors=_label_colors(labels, instance, marked, agents or {}),
        own=labels.id_map.get(OWN_BOX_ID, -1),
        centerness=oriented("centerness")[:, 0],
        offset=np.where(has_offset, offset, np.nan),
        flow=np.where(has_flow, flow, np.nan),
    )


def maps_of_output(
    output: MotionOutput,
    *,
    number: int = -1,
    step: float = 0.5,
    marked: Collection[int] = (),
    post_processing: PostProcessing | str = "motion",
) -> MotionMaps:
    """Convert one prediction of an output, by default the last, to `MotionMaps`.

    `step` is the time from frame to frame, seconds. Raises ChoiceError if the output has no such
    prediction, or the post-processing is unknown.
    """
    if number not in range(-len(output), len(output)):
        raise ChoiceError(
            f"prediction: expected a number from 0 to {len(output) - 1}, "
            f"or from the end, found {number}"
        )
    heads = None
    if output.heads is not None:
        heads = output.heads[number]
    if output.instances is not None:
        instance = np.asarray(output.instances[number])
    elif heads is not None:
        instance = predict_instances(heads, post_processing).instance
    else:  # only for the type checker: an output has heads or instances
        raise ChoiceError("prediction: has neither heads nor instances")
    instance = np.maximum(output.grid.reorient(instance, "devkit"), 0)
    head_maps: dict[str, AnyArray] = {}
    if heads is not None:
        head_maps = _head_maps(heads, instance)
    return MotionMaps(
        grid=output.grid.with_orientation("devkit"),
        step=step,
        at_present=True,
        valid=np.ones(len(instance), dtype=bool),
        instance=instance,
        colors=_palette(int(instance.max(initial=0)), marked),
        centerness=head_maps.get("centerness"),
        offset=head_maps.get("offset"),
        flow=head_maps.get("flow"),
    )


def _head_maps(heads: MotionHeads, instance: AnyArray) -> dict[str, AnyArray]:
    """Return the maps of network heads by name; vectors are NaN outside `instance` (T, H, W)."""
    oriented = heads.in_orientation("devkit")
    ignored = [] if oriented.ignore_index is None else [oriented.ignore_index]
    occupied = instance[:, None] > 0
    maps = {"centerness": oriented.centerness[:, 0]}
    for name, vectors in (("offset", oriented.offset), ("flow", oriented.flow)):
        is_ignored = np.isin(vectors, ignored).all(axis=1, keepdims=True)
        maps[name] = np.where(occupied & ~is_ignored, vectors, np.nan)
    return maps


def _label_colors(
    labels: MotionLabels, instance: AnyArray, marked: Collection[int], agents: Mapping[int, str]
) -> FloatArray:
    """Make the palette, shape (1 + ids, 3): red for marked actors, hues for agents (label ids).

    The ego's own box is dark, unless it is marked or has an agent's hue.
    """
    from matplotlib.colors import to_rgb

    max_id = max([int(instance.max(initial=0)), *labels.id_map.values()])
    instance_ids = {}
    for actor, instance_id in labels.id_map.items():
        if actor == OWN_BOX_ID:
            instance_ids[OWN_ACTOR_ID] = instance_id
        else:
            instance_ids[actor] = instance_id
    marked_ids = [instance_ids[actor] for actor in instance_ids if actor in marked]
    colors = _palette(max_id, marked_ids)
    hues = {OWN_ACTOR_ID: OWN_COLOR}
    for actor, agent in agents.items():
        hues[actor] = AGENT_COLORS[agent]
    for actor in hues.keys() & instance_ids.keys() - {*marked}:
        colors[instance_ids[actor]] = to_rgb(hues[actor])
    return colors


def _palette(max_id: int, marked: Collection[int]) -> FloatArray:
    """Make a palette, shape (1 + max_id, 3): white for 0, red for marked ids."""
    from matplotlib.colors import to_rgb

    shades = [to_rgb(color) for color in INSTANCE_COLORS]
    colors = np.array([shades[number % len(shades)] for number in range(1 + max_id)])
    colors[0] = 1.0
    for instance_id in marked:
        if 0 < instance_id <= max_id:
            colors[instance_id] = to_rgb(COLLIDER_COLOR)
    return colors


def draw_map_of(
    maps: MotionMaps, name: DrawnMap, frame: int, layers: frozenset[Layer], ax: Axes
) -> Axes:
    """Render one map of one frame, as `draw_motion_map` does."""
    ax.set(xlim=maps.grid.x[:2], ylim=maps.grid.y[:2], aspect="equal")
    if not maps.valid[frame]:
        ax.set_facecolor(BEYOND_COLOR)
        write_in_middle(ax, "not recorded")
        return ax
    if "labels" in layers:
        _draw_picture(maps, name, frame, layers, ax)
    if name == "flow":
        if "velocities" in layers:
            _draw_arrows(maps, frame, ax)
        if maps.instance[frame].any() and np.isnan(maps.vectors("flow")[frame]).all():
            write_in_middle(ax, "last frame:\nno flow")
    return _with_ids_and_grid(maps, frame, layers, ax)


def draw_trail_of(maps: MotionMaps, layers: frozenset[Layer], ax: Axes) -> Axes:
    """Render all frames, as `draw_motion_trail` does."""
    ax.set(xlim=maps.grid.x[:2], ylim=maps.grid.y[:2], aspect="equal")
    label_axes(ax, "ego")
    if "labels" in layers:
        instance = maps.instance.max(axis=0)
        picture = _above_road(trail_picture(maps.instance, maps.colors), instance, layers)
        draw_cells(ax, picture, maps.grid)
        _draw_edge(maps, maps.own, ax, OWN_COLOR)
    if "trajectories" in layers:
        _draw_paths(maps, ax)
    return _with_ids_and_grid(maps, 0, layers, ax)


def trail_picture(instance: AnyArray, colors: FloatArray) -> FloatArray:
    """Blend all frames into one picture, shape (H, W, 3), RGB from 0 to 1.

    Earlier frames are more opaque and on top.

    Args:
        instance: Ids of the cells, shape (T, H, W); 0 for free cells.
        colors: RGB colour of each id, shape (1 + ids, 3).
    """
    opacity = np.linspace(1.0, MIN_TRAIL_OPACITY, max(len(instance), 2))
    picture = np.ones((*instance.shape[1:], 3))
    for frame in reversed(range(len(instance))):
        is_occupied = instance[frame] > 0
        cell_colors = colors[instance[frame][is_occupied]]
        picture[is_occupied] = 1 - opacity[frame] * (1 - cell_colors)
    return picture


def draw_key(maps: MotionMaps, name: DrawnMap, ax: Axes) -> None:
    """Render a key that explains the colours of a map."""
    ax.axis("off")
    if name == "instance":
        handles = instance_handles(maps)
        if handles:
            ax.legend(
                handles=handles, loc="center left", frameon=False, borderpad=0, handlelength=1
            )
    elif name == "centerness":
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        scale = ScalarMappable(Normalize(0, 1), CENTERNESS_COLORMAP)
        ax.figure.colorbar(scale, cax=ax.inset_axes((0.1, 0.15, 0.15, 0.7)))
    else:
        side = np.linspace(-1, 1, 101)
        forward, left = np.meshgrid(side, side)
        is_inside = np.hypot(left, forward) <= 1
        colors = direction_colors(left, forward, longest=1.0)
        wheel = np.where(is_inside[..., None], colors, 1.0)
        ax.imshow(wheel, origin="lower", extent=(-1, 1, -1, 1))
        ax.text(0, -1.2, f"outer ring =\n{maps.longest(name):.0f} cells", ha="center", va="top")
        ax.text(0, 1.1, "left", ha="center", va="bottom")
        ax.text(1.1, 0, "forward", ha="left", va="center", rotation=270)


def direction_colors(left: AnyArray, forward: AnyArray, *, longest: float) -> AnyArray:
    """Return the colour of each vector's direction, shape (H, W, 3), paler for shorter vectors.

    Args:
        left: Components of the vectors to the left, shape (H, W).
        forward: Components of the vectors forward, shape (H, W).
        longest: Length of a vector that has the full colour.
    """
    from matplotlib.colors import to_rgb

    color_circle = [*DIRECTION_COLORS, DIRECTION_COLORS[0]]
    rgb = np.array([to_rgb(color) for color in color_circle])
    turns = np.arctan2(left, forward) / (2 * np.pi) % 1
    positions = turns * len(DIRECTION_COLORS)
    channels = [np.interp(positions, range(len(rgb)), channel) for channel in rgb.T]
    full_colors = np.stack(channels, axis=-1)
    strength = np.minimum(np.hypot(left, forward) / longest, 1)
    return _STILL_GREY - strength[..., None] * (_STILL_GREY - full_colors)


def _draw_picture(
    maps: MotionMaps, name: DrawnMap, frame: int, layers: frozenset[Layer], ax: Axes
) -> None:
    if name == "instance":
        instance = maps.instance[frame]
        picture = _above_road(maps.colors[instance], instance, layers)
        draw_cells(ax, picture, maps.grid)
        _draw_edge(maps, maps.own, ax, OWN_COLOR, frame=frame)
    elif name == "centerness":
        if maps.centerness is not None:
            draw_cells(
                ax, maps.centerness[frame], maps.grid, cmap=CENTERNESS_COLORMAP, vmin=0, vmax=1
            )
    else:
        vectors = maps.vectors(name)[frame]
        left, forward = np.nan_to_num(vectors)
        longest = maps.longest(name)
        colors = direction_colors(left, forward, longest=longest)
        colors[np.isnan(vectors[0])] = 1.0
        draw_cells(ax, colors, maps.grid)


def _draw_edge(maps: MotionMaps, instance_id: int, ax: Axes, color: str, *, frame: int = 0) -> None:
    """Draw the edge of an instance's cells."""
    cells = maps.instance[frame] == instance_id
    if cells.any():
        x, y = _cell_centers(maps)
        ax.contour(x, y, cells, levels=(0.5,), colors=color, linewidths=_OWN_EDGE_WIDTH_PT)


def _draw_arrows(maps: MotionMaps, frame: int, ax: Axes) -> None:
    """Draw one arrow for each instance, from its cells' mean position, along its mean flow."""
    flow = maps.vectors("flow")[frame]
    is_known = ~np.isnan(flow[0])
    if not is_known.any():
        return
    row, column = np.nonzero(is_known)
    x, y = _cell_centers(maps)
    ids = maps.instance[frame][is_known]
    _, member, count = np.unique(ids, return_inverse=True, return_counts=True)
    means = []
    for values in (x[column], y[row], *flow[:, is_known]):
        sums = np.bincount(member.ravel(), weights=values)
        means.append(sums / count)
    start_x, start_y, step_y, step_x = means
    ax.quiver(
        start_x,
        start_y,
        step_x * maps.grid.x[2],
        step_y * maps.grid.y[2],
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.007,
        headlength=4,
        zorder=3,
    )


def _draw_paths(maps: MotionMaps, ax: Axes) -> None:
    """Draw each instance's path as a line, with a dot at each frame after the current one.

    A path connects the centres of the instance's cells in each frame.
    """
    from matplotlib.collections import LineCollection

    paths = []
    colors = []
    for instance_id, path in maps.paths().items():
        if len(path) > 1:
            paths.append(path)
            # darker than the cells beneath them
            colors.append(maps.colors[instance_id] * 0.6)
    ax.add_collection(LineCollection(paths, colors=colors, linewidths=1.3, zorder=4))
    if paths:
        future_paths = [path[1:] for path in paths]
        dot_colors = np.repeat(colors, [len(path) for path in future_paths], axis=0)
        x, y = np.concatenate(future_paths).T
        ax.scatter(x, y, s=6, c=dot_colors, zorder=4, linewidths=0)


def _with_ids_and_grid(maps: MotionMaps, frame: int, layers: frozenset[Layer], ax: Axes) -> Axes:
    if "ids" in layers:
        instance = maps.instance[frame]
        x, y = _cell_centers(maps)
        for instance_id in np.unique(instance[instance > 0]).tolist():
            row, column = np.nonzero(instance == instance_id)
            centers = np.column_stack([x[column], y[row]])
            corners = [centers.min(axis=0), centers.max(axis=0)]
            position = (x[column].mean(), y[row].mean())
            place_chips(ax, [(str(instance_id), position)], avoid=[corners])
    if "grid" in layers:
        return with_light_grid(ax, "both")
    return ax


def _above_road(picture: AnyArray, instance: AnyArray, layers: frozenset[Layer]) -> AnyArray:
    """Make free cells of an RGB picture (H, W, 3) transparent if the road is drawn beneath it."""
    if "bev" not in layers:
        return picture
    return np.dstack([picture, instance > 0])


def draw_cells(ax: Axes, picture: AnyArray, grid: BevGrid, **style: Any) -> None:
    """Render a picture (H, W), (H, W, 3) or (H, W, 4) of the cells of a grid."""
    ax.imshow(
        picture,
        origin="lower",
        extent=(*grid.x[:2], *grid.y[:2]),
        interpolation="nearest",
        **style,
    )


def instance_handles(maps: MotionMaps) -> list[Artist]:
    """Make legend handles for the hues of instances, and for the recording agent's own box."""
    from matplotlib.colors import to_hex
    from matplotlib.patches import Patch

    drawn_ids = np.unique(maps.instance)
    drawn_colors = {to_hex(color) for color in maps.colors[drawn_ids]}
    handles: list[Artist] = []
    for name, color in hue_meanings().items():
        if color in drawn_colors:
            handles.append(Patch(label=name, facecolor=color))
    if maps.own > 0:
        handles.append(
            Patch(
                label="own vehicle",
                facecolor="none",
                edgecolor=OWN_COLOR,
                linewidth=_OWN_EDGE_WIDTH_PT,
            )
        )
    return handles


def trail_handles(maps: MotionMaps, layers: Collection[Layer]) -> list[Artist]:
    """Make legend handles for the paleness and the dots of a trail."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    color = INSTANCE_COLORS[0]
    seconds = maps.step * (len(maps.valid) - 1)
    pale_color = (color, MIN_TRAIL_OPACITY)
    handles: list[Artist] = []
    if "labels" in layers:
        handles.append(Patch(label="others now", facecolor=color))
        handles.append(Patch(label=f"in {seconds:g} s", facecolor=pale_color))
    if "trajectories" in layers:
        label = f"every {maps.step:g} s"
        handles.append(Line2D([], [], color=color, marker="o", markersize=3, label=label))
    return handles


def _cell_centers(maps: MotionMaps) -> tuple[FloatArray, FloatArray]:
    """Return the x coordinates of the columns' centres and the y of the rows' centres, metres."""
    centers = maps.grid.centers()
    x = centers[0, :, 0]
    y = centers[:, 0, 1]
    return x, y
