"""`MotionMaps`: motion in one form for labels and predictions, and the rendering of its cells."""

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
# Opacity of the last frame of a trail; the present is 1.
MIN_TRAIL_OPACITY: Final = 0.22
# Points: width of the edge of the own box.
_OWN_EDGE_WIDTH_PT: Final = 1.0
# Grey of cells that do not move.
_STILL_GREY: Final = 0.92


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionMaps(FrozenArrays):
    """Motion of T frames in the form of pictures; arrays are read-only.

    Rows of cells are along y left, columns along x forward.

    Attributes:
        grid: Cells, in the devkit's orientation.
        step: Seconds from frame to frame.
        at_present: Whether all frames are in the present ego frame; if not, each is in its own.
        valid: Whether a frame exists, (T,) bool.
        instance: Ids from 1, shape (T, H, W); 0 for other cells and for missing frames.
        colors: Red, green, blue of each id, shape (1 + ids, 3); white for 0.
        own: Id of the ego's own box; −1 if unknown.
        centerness: Centerness in [0, 1], shape (T, H, W); None if there are only instances.
        offset: Cells to the left and forward, shape (T, 2, H, W), NaN outside instances; None if
            there are only instances.
        flow: Cells, shape (T, 2, H, W), as the offset; also NaN where it is unknown.
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
        return tuple(name for name in DRAWN_MAPS if getattr(self, name) is not None)

    def vectors(self, name: DrawnMap) -> AnyArray:
        """Return `offset` or `flow`, shape (T, 2, H, W); raises ChoiceError if it is missing."""
        maps = getattr(self, name)
        if maps is None:
            raise ChoiceError(
                f"map: this prediction has only {', '.join(self.names)}, not {name}; "
                "give heads for it"
            )
        return np.asarray(maps)

    def longest(self, name: DrawnMap) -> float:
        """Return the length of a map's longest vector in all frames, in cells, at least 1.

        It is 1 for maps without vectors.
        """
        if name not in ("offset", "flow"):
            return 1.0
        length = np.linalg.norm(self.vectors(name), axis=1)
        return max(1.0, float(np.nan_to_num(length).max(initial=0)))

    def paths(self) -> dict[int, FloatArray]:
        """Return the paths of the first frame's instances: id → (n, 2) x forward, y left (m)."""
        if not self.valid[0]:
            return {}
        return instance_paths(self.instance[self.valid], self.grid)


def maps_of_labels(
    labels: MotionLabels, marked: Collection[int] = (), agents: Mapping[int, str] | None = None
) -> MotionMaps:
    """Return labels in the form of pictures.

    `marked` actors are red, `agents` have their hues (both by label ids).
    """
    source, ignore = labels.config.grid.orientation, labels.config.ignore_index
    valid = labels.label_valid

    def oriented(name: str, *, vectors: bool = False) -> AnyArray:
        return to_orientation(
            getattr(labels, name), vectors=vectors, source=source, target="devkit", ignore=ignore
        )

    instance = np.where(valid[:, None, None], oriented("instance"), 0)
    occupied = instance[:, None] > 0
    offset, flow = oriented("offset", vectors=True), oriented("flow", vectors=True)
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
    """Return one prediction of an output, by default the last, in the form of pictures.

    `step` is seconds from frame to frame. Raises ChoiceError.
    """
    if number not in range(-len(output), len(output)):
        raise ChoiceError(
            f"prediction: expected a number from 0 to {len(output) - 1}, "
            f"or from the end, found {number}"
        )
    heads = None
    if output.heads is not None:
        heads = output.heads[number]
    instance = _predicted_instances(output, heads, number, post_processing)
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


def _predicted_instances(
    output: MotionOutput,
    heads: MotionHeads | None,
    number: int,
    post_processing: PostProcessing | str,
) -> AnyArray:
    """Return the instances of one prediction, shape (T, H, W), in its own orientation."""
    if output.instances is not None:
        return np.asarray(output.instances[number])
    if heads is None:  # only for the type checker: an output has one of them
        raise ChoiceError("prediction: has neither heads nor instances")
    return predict_instances(heads, post_processing).instance


def _head_maps(heads: MotionHeads, instance: AnyArray) -> dict[str, AnyArray]:
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
    """Return the palette with red for marked actors and hues for agents.

    An own box that has neither is dark.
    """
    from matplotlib.colors import to_rgb

    max_id = max([int(instance.max(initial=0)), *labels.id_map.values()])
    instance_ids = {}
    for actor, instance_id in labels.id_map.items():
        instance_ids[OWN_ACTOR_ID if actor == OWN_BOX_ID else actor] = instance_id
    marked_ids = [instance_ids[actor] for actor in instance_ids if actor in marked]
    colors = _palette(max_id, marked_ids)
    hues = {OWN_ACTOR_ID: OWN_COLOR}
    for actor, agent in agents.items():
        hues[actor] = AGENT_COLORS[agent]
    for actor in hues.keys() & instance_ids.keys() - {*marked}:
        colors[instance_ids[actor]] = to_rgb(hues[actor])
    return colors


def _palette(max_id: int, marked: Collection[int]) -> FloatArray:
    """Return a colour for each id, shape (1 + ids, 3): white for 0, red for marked ids."""
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
    """Render one map of one frame, in the way of `draw_motion_map`."""
    ax.set(xlim=maps.grid.x[:2], ylim=maps.grid.y[:2], aspect="equal")
    if not maps.valid[frame]:
        ax.set_facecolor(BEYOND_COLOR)
        write_in_middle(ax, "not recorded")
        return ax
    if "labels" in layers:
        _draw_picture(maps, name, frame, ax)
    if name == "flow":
        if "velocities" in layers:
            _draw_arrows(maps, frame, ax)
        if maps.instance[frame].any() and np.isnan(maps.vectors("flow")[frame]).all():
            write_in_middle(ax, "no next frame")
    return _with_ids_and_grid(maps, frame, layers, ax)


def draw_trail_of(maps: MotionMaps, layers: frozenset[Layer], ax: Axes) -> Axes:
    """Render all frames, in the way of `draw_motion_trail`."""
    ax.set(xlim=maps.grid.x[:2], ylim=maps.grid.y[:2], aspect="equal")
    label_axes(ax, "ego")
    if "labels" in layers:
        _draw_cells(ax, trail_picture(maps), maps)
        draw_edge(maps, maps.own, ax, OWN_COLOR)
    if "trajectories" in layers:
        _draw_paths(maps, ax)
    return _with_ids_and_grid(maps, 0, layers, ax)


def trail_picture(maps: MotionMaps) -> FloatArray:
    """Return the colours of all frames over each other, shape (H, W, 3).

    Earlier frames are stronger and on top.
    """
    frames = np.flatnonzero(maps.valid).tolist()
    opacity = np.linspace(1.0, MIN_TRAIL_OPACITY, max(len(maps.valid), 2))
    picture = np.ones((*maps.instance.shape[1:], 3))
    for frame in reversed(frames):
        occupied = maps.instance[frame] > 0
        colors = maps.colors[maps.instance[frame][occupied]]
        picture[occupied] = 1 - opacity[frame] * (1 - colors)
    return picture


def draw_key(maps: MotionMaps, name: DrawnMap, ax: Axes) -> None:
    """Render the meaning of the colours of a map."""
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
        ax.text(0, -1.2, f"rim: {maps.longest(name):.0f} cells", ha="center", va="top")
        ax.text(0, 1.1, "left", ha="center", va="bottom")
        ax.text(1.1, 0, "forward", ha="left", va="center", rotation=270)


def direction_colors(left: AnyArray, forward: AnyArray, *, longest: float) -> AnyArray:
    """Return a colour for the direction of vectors (left, forward), paler for shorter ones.

    The shape is (H, W, 3).
    """
    from matplotlib.colors import to_rgb

    corners = np.array([to_rgb(color) for color in (*DIRECTION_COLORS, DIRECTION_COLORS[0])])
    turn = np.arctan2(left, forward) / (2 * np.pi) % 1 * len(DIRECTION_COLORS)
    channels = [np.interp(turn, range(len(corners)), channel) for channel in corners.T]
    full = np.stack(channels, axis=-1)
    strength = np.minimum(np.hypot(left, forward) / longest, 1)
    return _STILL_GREY - strength[..., None] * (_STILL_GREY - full)


def _draw_picture(maps: MotionMaps, name: DrawnMap, frame: int, ax: Axes) -> None:
    if name == "instance":
        _draw_cells(ax, maps.colors[maps.instance[frame]], maps)
        draw_edge(maps, maps.own, ax, OWN_COLOR, frame=frame)
    elif name == "centerness":
        if maps.centerness is not None:
            _draw_cells(ax, maps.centerness[frame], maps, cmap=CENTERNESS_COLORMAP, vmin=0, vmax=1)
    else:
        vectors = maps.vectors(name)[frame]
        colors = direction_colors(*np.nan_to_num(vectors), longest=maps.longest(name))
        _draw_cells(ax, np.where(np.isnan(vectors[0])[..., None], 1.0, colors), maps)


def draw_edge(maps: MotionMaps, instance_id: int, ax: Axes, color: str, *, frame: int = 0) -> None:
    """Render the edge of an instance's cells."""
    cells = maps.instance[frame] == instance_id
    if cells.any():
        x, y = _cell_centers(maps)
        ax.contour(x, y, cells, levels=(0.5,), colors=color, linewidths=_OWN_EDGE_WIDTH_PT)


def _draw_arrows(maps: MotionMaps, frame: int, ax: Axes) -> None:
    """Draw one arrow for each instance, from the mean of its cells, along the mean of its flow."""
    flow, instance = maps.vectors("flow")[frame], maps.instance[frame]
    known = ~np.isnan(flow[0])
    if not known.any():
        return
    row, column = np.nonzero(known)
    x, y = _cell_centers(maps)
    _, member, count = np.unique(instance[known], return_inverse=True, return_counts=True)
    left, forward = flow[:, known]
    means = []
    for values in (x[column], y[row], left, forward):
        means.append(np.bincount(member.ravel(), weights=values) / count)
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
    """Draw one line for each instance along the centres of its cells.

    There is a dot at each frame after the present.
    """
    from matplotlib.collections import LineCollection

    paths, colors = [], []
    for instance_id, path in maps.paths().items():
        if len(path) > 1:
            paths.append(path)
            # darker than the cells that they lie on
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
            low, high = (x[column.min()], y[row.min()]), (x[column.max()], y[row.max()])
            chip = (str(instance_id), (x[column].mean(), y[row].mean()))
            place_chips(ax, [chip], avoid=[[low, high]])
    if "grid" in layers:
        return with_light_grid(ax, "both")
    return ax


def _draw_cells(ax: Axes, picture: AnyArray, maps: MotionMaps, **style: Any) -> None:
    ax.imshow(
        picture,
        origin="lower",
        extent=(*maps.grid.x[:2], *maps.grid.y[:2]),
        interpolation="nearest",
        **style,
    )


def instance_handles(maps: MotionMaps) -> list[Artist]:
    """Return handles for the hues of instances."""
    from matplotlib.colors import to_hex
    from matplotlib.patches import Patch

    drawn_colors = {to_hex(color) for color in maps.colors}
    handles: list[Artist] = []
    for name, color in hue_meanings().items():
        if color in drawn_colors:
            handles.append(Patch(label=name, facecolor=color))
    if maps.own > 0:
        handles.append(
            Patch(
                label="own box",
                facecolor="none",
                edgecolor=OWN_COLOR,
                linewidth=_OWN_EDGE_WIDTH_PT,
            )
        )
    return handles


def _cell_centers(maps: MotionMaps) -> tuple[FloatArray, FloatArray]:
    """Return x of the columns' centres and y of the rows' centres, metres."""
    centers = maps.grid.centers()
    return centers[0, :, 0], centers[:, 0, 1]
