"""`MotionMaps`, what pictures show of motion, in one form for labels and predictions; and how cells are rendered."""

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
from deepaccident_devkit.render.chips import place_chips
from deepaccident_devkit.render.figures import Layer, with_light_grid
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
from deepaccident_devkit.taxonomy import FRAME_PERIOD, OWN_ACTOR_ID, short_name

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

DrawnMap = Literal["instance", "centerness", "offset", "flow"]
DRAWN_MAPS: Final[tuple[DrawnMap, ...]] = get_args(DrawnMap)
# How opaque the last frame of a trail is; the present is 1.
PALEST: Final = 0.22
# Points of the edge of the own box.
_OWN_EDGE: Final = 1.0
# Grey of what does not move.
_STILL: Final = 0.92


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionMaps(FrozenArrays):
    """Motion of T frames as it is rendered: rows of cells along y left, columns along x forward; arrays are read-only.

    Attributes:
        grid: the cells, in the devkit's orientation.
        step: seconds from frame to frame.
        at_present: whether all frames are in the present ego frame; if not, each is in its own.
        valid: (T,) bool: which frames exist.
        instance: (T, H, W) ids from 1, 0 elsewhere and in frames that do not exist.
        colors: (1 + ids, 3) red, green, blue of each id; white of 0.
        own: the id of the ego's own box; −1 if it is not known.
        centerness: (T, H, W) in [0, 1]; None if there are only instances.
        offset: (T, 2, H, W) cells to the left and forward, NaN outside instances; None if there are only instances.
        flow: (T, 2, H, W) as the offset; NaN also where it is not known.
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
        """The names of the maps that are not None."""
        return tuple(name for name in DRAWN_MAPS if getattr(self, name) is not None)

    def vectors(self, name: DrawnMap) -> AnyArray:
        """`offset` or `flow`, (T, 2, H, W); raises ChoiceError if it is not there."""
        maps = getattr(self, name)
        if maps is None:
            raise ChoiceError(
                f"map: this prediction has only {', '.join(self.names)}, not {name}; give heads for it"
            )
        return np.asarray(maps)

    def longest(self, name: DrawnMap) -> float:
        """The length of a map's longest vector in all frames, in cells, at least 1; 1 for maps without vectors."""
        if name not in ("offset", "flow"):
            return 1.0
        length = np.linalg.norm(self.vectors(name), axis=1)
        return max(1.0, float(np.nan_to_num(length).max(initial=0)))

    def paths(self) -> dict[int, FloatArray]:
        """Where the instances of the first frame go: id → (n, 2) x forward, y left, metres."""
        return instance_paths(self.instance[self.valid], self.grid) if self.valid[0] else {}


def maps_of_labels(
    labels: MotionLabels, marked: Collection[int] = (), agents: Mapping[int, str] | None = None
) -> MotionMaps:
    """Labels as they are rendered; `marked` actors are red, `agents` have their hues (both by label ids)."""
    source, ignore = labels.config.grid.orientation, labels.config.ignore_index
    valid = labels.label_valid

    def lying(name: str, *, vectors: bool = False) -> AnyArray:
        return to_orientation(
            getattr(labels, name), vectors=vectors, source=source, target="devkit", ignore=ignore
        )

    instance = np.where(valid[:, None, None], lying("instance"), 0)
    known = instance[:, None] > 0
    offset, flow = (
        np.where(known & (maps != ignore).any(axis=1, keepdims=True), maps, np.nan)
        for maps in (lying("offset", vectors=True), lying("flow", vectors=True))
    )
    return MotionMaps(
        grid=labels.config.grid.with_orientation("devkit"),
        step=labels.config.step * FRAME_PERIOD,
        at_present=labels.at_present,
        valid=valid,
        instance=instance,
        colors=_label_colors(labels, instance, marked, agents or {}),
        own=labels.id_map.get(OWN_BOX_ID, -1),
        centerness=lying("centerness")[:, 0],
        offset=offset,
        flow=flow,
    )


def maps_of_output(
    output: MotionOutput,
    *,
    number: int = -1,
    step: float = 0.5,
    marked: Collection[int] = (),
    post_processing: PostProcessing | str = "motion",
) -> MotionMaps:
    """One prediction of an output, by default the last, with `step` seconds from frame to frame. Raises ChoiceError."""
    if number not in range(-len(output), len(output)):
        raise ChoiceError(
            f"prediction: expected a number from 0 to {len(output) - 1}, or from the end, found {number}"
        )
    grid, heads = (
        output.grid.with_orientation("devkit"),
        None if output.heads is None else output.heads[number],
    )
    instance = _found(output, heads, number, post_processing)
    instance = np.maximum(output.grid.reorient(instance, "devkit"), 0)
    more = {} if heads is None else _head_maps(heads, instance)
    return MotionMaps(
        grid=grid,
        step=step,
        at_present=True,
        valid=np.ones(len(instance), dtype=bool),
        instance=instance,
        colors=_palette(int(instance.max(initial=0)), marked),
        centerness=more.get("centerness"),
        offset=more.get("offset"),
        flow=more.get("flow"),
    )


def _found(
    output: MotionOutput,
    heads: MotionHeads | None,
    number: int,
    post_processing: PostProcessing | str,
) -> AnyArray:
    """(T, H, W) the instances of one prediction, in its own orientation."""
    if output.instances is not None:
        return np.asarray(output.instances[number])
    if heads is None:  # only for the type checker: an output has one of them
        raise ChoiceError("prediction: has neither heads nor instances")
    return predict_instances(heads, post_processing).instance


def _head_maps(heads: MotionHeads, instance: AnyArray) -> dict[str, AnyArray]:
    lying = heads.in_orientation("devkit")
    ignored = [] if lying.ignore_index is None else [lying.ignore_index]
    known = instance[:, None] > 0
    offset, flow = (
        np.where(known & ~np.isin(maps, ignored).all(axis=1, keepdims=True), maps, np.nan)
        for maps in (lying.offset, lying.flow)
    )
    return {"centerness": lying.centerness[:, 0], "offset": offset, "flow": flow}


def _label_colors(
    labels: MotionLabels, instance: AnyArray, marked: Collection[int], agents: Mapping[int, str]
) -> FloatArray:
    """The palette with red for marked actors, agents' hues, and a dark colour for an own box that has neither."""
    from matplotlib.colors import to_rgb

    highest = max([int(instance.max(initial=0)), *labels.id_map.values()])
    named = {
        OWN_ACTOR_ID if actor == OWN_BOX_ID else actor: identity
        for actor, identity in labels.id_map.items()
    }
    colors = _palette(highest, [identity for actor, identity in named.items() if actor in marked])
    hues = {OWN_ACTOR_ID: OWN_COLOR} | {
        actor: AGENT_COLORS[agent] for actor, agent in agents.items()
    }
    for actor in hues.keys() & named.keys() - {*marked}:
        colors[named[actor]] = to_rgb(hues[actor])
    return colors


def _palette(highest: int, marked: Collection[int]) -> FloatArray:
    """(1 + ids, 3) white for the background, a colour of the palette for each id, red for some."""
    from matplotlib.colors import to_rgb

    shades = [to_rgb(color) for color in INSTANCE_COLORS]
    colors = np.array([shades[number % len(shades)] for number in range(1 + highest)])
    colors[0] = 1.0
    for identity in marked:
        if 0 < identity <= highest:
            colors[identity] = to_rgb(COLLIDER_COLOR)
    return colors


def draw_map_of(
    maps: MotionMaps, name: DrawnMap, frame: int, shown: frozenset[Layer], ax: Axes
) -> Axes:
    """Render one map of one frame as `draw_motion_map` says; `shown` are its layers."""
    ax.set(xlim=maps.grid.x[:2], ylim=maps.grid.y[:2], aspect="equal")
    if not maps.valid[frame]:
        ax.set_facecolor(BEYOND_COLOR)
        ax.text(0.5, 0.5, "not recorded", ha="center", va="center", transform=ax.transAxes)
        return ax
    if "labels" in shown:
        _draw_picture(maps, name, frame, ax)
    if name == "flow" and "velocities" in shown:
        _draw_arrows(maps, frame, ax)
    if (
        name == "flow"
        and maps.instance[frame].any()
        and np.isnan(maps.vectors("flow")[frame]).all()
    ):
        ax.text(0.5, 0.5, "no next frame", ha="center", va="center", transform=ax.transAxes)
    return _with_ids_and_grid(maps, frame, shown, ax)


def draw_trail_of(maps: MotionMaps, shown: frozenset[Layer], ax: Axes) -> Axes:
    """Render all frames as `draw_motion_trail` says; `shown` are its layers."""
    ax.set(
        xlim=maps.grid.x[:2],
        ylim=maps.grid.y[:2],
        aspect="equal",
        xlabel="x forward (m)",
        ylabel="y left (m)",
    )
    if "labels" in shown:
        _draw_cells(ax, trail_picture(maps), maps)
        draw_edge(maps, maps.own, ax, OWN_COLOR)
    if "trajectories" in shown:
        _draw_paths(maps, ax)
    return _with_ids_and_grid(maps, 0, shown, ax)


def trail_picture(maps: MotionMaps) -> FloatArray:
    """(H, W, 3) the colours of all frames over each other; earlier frames are stronger and on top."""
    frames = np.flatnonzero(maps.valid).tolist()
    opacity = np.linspace(1.0, PALEST, max(len(maps.valid), 2))
    picture = np.ones((*maps.instance.shape[1:], 3))
    for frame in reversed(frames):
        here = maps.instance[frame] > 0
        colors = maps.colors[maps.instance[frame][here]]
        picture[here] = 1 - opacity[frame] * (1 - colors)
    return picture


def draw_key(maps: MotionMaps, name: DrawnMap, ax: Axes) -> None:
    """What the colours of a map mean."""
    ax.axis("off")
    if name == "instance":
        if handles := instance_handles(maps):
            ax.legend(
                handles=handles, loc="center left", frameon=False, borderpad=0, handlelength=1
            )
    elif name == "centerness":
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        ax.figure.colorbar(
            ScalarMappable(Normalize(0, 1), CENTERNESS_COLORMAP),
            cax=ax.inset_axes((0.1, 0.15, 0.15, 0.7)),
        )
    else:
        side = np.linspace(-1, 1, 101)
        along, left = np.meshgrid(side, side)
        wheel = np.where(
            (np.hypot(left, along) <= 1)[..., None], direction_colors(left, along, longest=1.0), 1.0
        )
        ax.imshow(wheel, origin="lower", extent=(-1, 1, -1, 1))
        ax.text(0, -1.2, f"rim: {maps.longest(name):.0f} cells", ha="center", va="top")
        ax.text(0, 1.1, "left", ha="center", va="bottom")
        ax.text(1.1, 0, "forward", ha="left", va="center", rotation=270)


def direction_colors(left: AnyArray, along: AnyArray, *, longest: float) -> AnyArray:
    """(H, W, 3) a colour for the direction of vectors (left, forward), paler for shorter ones."""
    from matplotlib.colors import to_rgb

    corners = np.array([to_rgb(color) for color in (*DIRECTION_COLORS, DIRECTION_COLORS[0])])
    turn = np.arctan2(left, along) / (2 * np.pi) % 1 * len(DIRECTION_COLORS)
    full = np.stack([np.interp(turn, range(len(corners)), each) for each in corners.T], axis=-1)
    strength = np.minimum(np.hypot(left, along) / longest, 1)
    return _STILL - strength[..., None] * (_STILL - full)


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


def draw_edge(maps: MotionMaps, identity: int, ax: Axes, color: str, *, frame: int = 0) -> None:
    """Render the edge of an instance's cells."""
    cells = maps.instance[frame] == identity
    if cells.any():
        ax.contour(*_cell_centers(maps), cells, levels=(0.5,), colors=color, linewidths=_OWN_EDGE)


def _draw_arrows(maps: MotionMaps, frame: int, ax: Axes) -> None:
    """One arrow for each instance, from the mean of its cells, along the mean of their flow."""
    flow, instance = maps.vectors("flow")[frame], maps.instance[frame]
    known = ~np.isnan(flow[0])
    if not known.any():
        return
    row, column = np.nonzero(known)
    x, y = _cell_centers(maps)
    _, member, count = np.unique(instance[known], return_inverse=True, return_counts=True)
    left, along = flow[:, known]
    start_x, start_y, step_y, step_x = (
        np.bincount(member.ravel(), weights=values) / count
        for values in (x[column], y[row], left, along)
    )
    steps = step_x * maps.grid.x[2], step_y * maps.grid.y[2]
    ax.quiver(
        start_x,
        start_y,
        *steps,
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.007,
        headlength=4,
        zorder=3,
    )


def _draw_paths(maps: MotionMaps, ax: Axes) -> None:
    """One line for each instance along the centres of its cells, with a dot at each frame after the present."""
    from matplotlib.collections import LineCollection

    paths = {identity: path for identity, path in maps.paths().items() if len(path) > 1}
    colors = [
        maps.colors[identity] * 0.6 for identity in paths
    ]  # darker than the cells that they lie on
    ax.add_collection(LineCollection(list(paths.values()), colors=colors, linewidths=1.3, zorder=4))
    if paths:
        later = [path[1:] for path in paths.values()]
        repeated = np.repeat(colors, [len(path) for path in later], axis=0)
        x, y = np.concatenate(later).T
        ax.scatter(x, y, s=6, c=repeated, zorder=4, linewidths=0)


def _with_ids_and_grid(maps: MotionMaps, frame: int, shown: frozenset[Layer], ax: Axes) -> Axes:
    if "ids" in shown:
        x, y = _cell_centers(maps)
        for identity in np.unique(maps.instance[frame][maps.instance[frame] > 0]).tolist():
            row, column = np.nonzero(maps.instance[frame] == identity)
            low, high = (x[column.min()], y[row.min()]), (x[column.max()], y[row.max()])
            place_chips(
                ax, [(str(identity), (x[column].mean(), y[row].mean()))], avoid=[[low, high]]
            )
    return with_light_grid(ax, "both") if "grid" in shown else ax


def _draw_cells(ax: Axes, picture: AnyArray, maps: MotionMaps, **how: Any) -> None:
    ax.imshow(
        picture,
        origin="lower",
        extent=(*maps.grid.x[:2], *maps.grid.y[:2]),
        interpolation="nearest",
        **how,
    )


def instance_handles(maps: MotionMaps) -> list[Artist]:
    """What the hues of instances mean."""
    from matplotlib.colors import to_hex
    from matplotlib.patches import Patch

    drawn = {to_hex(color) for color in maps.colors}
    meanings = {"colliding pair": COLLIDER_COLOR} | {
        short_name(name): hue for name, hue in AGENT_COLORS.items()
    }
    handles: list[Artist] = [
        Patch(label=name, facecolor=color) for name, color in meanings.items() if color in drawn
    ]
    if maps.own > 0:
        handles.append(
            Patch(label="own box", facecolor="none", edgecolor=OWN_COLOR, linewidth=_OWN_EDGE)
        )
    return handles


def _cell_centers(maps: MotionMaps) -> tuple[FloatArray, FloatArray]:
    """Metres: x of the columns' centres and y of the rows' centres."""
    centers = maps.grid.centers()
    return centers[0, :, 0], centers[:, 0, 1]
