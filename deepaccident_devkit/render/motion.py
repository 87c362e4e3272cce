"""Motion labels as pictures."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

import numpy as np

from deepaccident_devkit.arrays import AnyArray, BoolArray, FloatArray
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabelConfig, MotionLabels, motion_labels
from deepaccident_devkit.motion.orientations import to_orientation
from deepaccident_devkit.render.axes import axes_or_new, figure_or_new
from deepaccident_devkit.render.bev import collider_ids
from deepaccident_devkit.render.colors import COLLIDER_COLOR, OWN_COLOR
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DrawnMap = Literal["instance", "centerness", "offset", "flow"]
_MAPS: Final[tuple[DrawnMap, ...]] = get_args(DrawnMap)
_PALETTE: Final = (0, 1, 2, 3, 8, 9, 10, 11, 12, 13, 16, 17, 18, 19)
"""Of matplotlib's tab20: without its greens, reds and greys, which mean something here."""
_BEYOND_COLOR: Final = "#e4e4e4"
_KEY_WIDTH: Final = 0.5
"""Of the column that explains the colours, in widths of a panel."""


def render_motion_labels(
    dataset: Dataset,
    sample: RowArgument,
    config: MotionLabelConfig | None = None,
    *,
    at_present: bool = True,
    fig: Figure | None = None,
) -> Figure:
    """Draw a sample's motion labels: a column a frame; instances, centerness, offset and flow below each other.

    Args:
        dataset: the release.
        sample: token or record.
        config: what labels show; None for the released ones.
        at_present: warp all frames to the present ego frame; else each is in its own.
        fig: an empty figure to draw on; a new one if None.

    Returns:
        The figure drawn on; `draw_motion_map` says what is what.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label.
    """
    labels = motion_labels(dataset, sample, config)
    if at_present:
        labels = labels.to_present()
    fig = draw_motion_labels(labels, marked=collider_ids(dataset, sample), fig=fig)
    fig.suptitle(dataset.get("sample", sample)["token"])
    return fig


def draw_motion_labels(labels: MotionLabels, *, marked: Collection[int] = (), fig: Figure | None = None) -> Figure:
    """Draw labels as `render_motion_labels` does; actors whose label ids are `marked` are red (the ego itself: −100).

    Args:
        labels: at the present or each frame in its own ego frame, as they are.
        marked: label ids.
        fig: an empty figure to draw on; a new one if None.

    Returns:
        The figure drawn on.
    """
    frames = labels.config.label_frames
    fig = figure_or_new(fig, (2.8 * (frames + _KEY_WIDTH) + 0.6, 2.8 * len(_MAPS) + 0.8))
    axes = fig.subplots(len(_MAPS), frames + 1, squeeze=False, width_ratios=(*[1.0] * frames, _KEY_WIDTH))
    panels = axes[:, :frames]
    for row, name in enumerate(_MAPS):
        for frame in range(frames):
            draw_motion_map(labels, name, frame, marked=marked, ax=panels[row, frame])
        panels[row, 0].set_ylabel(f"{name}\ny left (m)")
        _draw_key(name, _longest(labels, name), axes[row, frames])
    seconds = labels.config.step / 10
    for frame, ax in enumerate(panels[0]):
        ax.set_title(f"+{frame * seconds:.1f} s" if frame else "present")
    for ax in panels.flat:
        if ax is not panels[0, 0]:
            ax.sharex(panels[0, 0])
            ax.sharey(panels[0, 0])
        ax.label_outer()
    where = "the present" if labels.at_present else "each frame's own"
    fig.supxlabel(f"x forward (m), in {where} ego frame", fontsize="medium")
    return fig


def draw_motion_map(
    labels: MotionLabels, name: DrawnMap, frame: int, *, marked: Collection[int] = (), ax: Axes | None = None
) -> Axes:
    """Draw one map of one label frame, in metres of the ego frame that it is in: forward to the right, left up.

    Instances have a colour each, which they keep over the frames; `marked` ones are red. The ego's own box has a green
    edge, and is green where it is not marked. Colours of offset and flow are directions, paler for shorter vectors, on
    a scale of their own for each map. Each instance has an arrow to where its flow takes it, or a dot if it stays. A
    frame beyond the recording is grey.

    Args:
        labels: at the present or not.
        name: of the map.
        frame: 0 is the present.
        marked: label ids of actors; the ego's own is −100.
        ax: axes to draw on; new ones if None.

    Returns:
        The axes drawn on.

    Raises:
        ChoiceError: no such map, or no such frame.
    """
    if name not in _MAPS:
        raise ChoiceError(f"map: expected one of {', '.join(_MAPS)}, found {name!r}")
    if frame not in range(labels.config.label_frames):
        raise ChoiceError(f"frame: expected 0 to {labels.config.label_frames - 1}, found {frame!r}")
    ax = axes_or_new(ax)
    x, y = labels.config.grid.x, labels.config.grid.y
    ax.set(xlim=x[:2], ylim=y[:2], aspect="equal")
    if not labels.label_valid[frame]:
        ax.set_facecolor(_BEYOND_COLOR)
        ax.text(0.5, 0.5, "not recorded", ha="center", va="center", transform=ax.transAxes)
        return ax
    if name == "instance":
        _draw_instances(labels, frame, marked, ax)
    elif name == "centerness":
        _draw_cells(ax, _devkit_map(labels, name, frame)[0], labels, cmap="magma", vmin=0, vmax=1)
    else:
        _draw_vectors(labels, name, frame, ax)
    return ax


def _draw_instances(labels: MotionLabels, frame: int, marked: Collection[int], ax: Axes) -> None:
    instance = _devkit_map(labels, "instance", frame)
    _draw_cells(ax, _instance_colors(labels, marked)[instance], labels)
    own = instance == labels.id_map.get(OWN_BOX_ID, -1)
    if own.any():
        ax.contour(*_cell_centers(labels), own, levels=(0.5,), colors=OWN_COLOR, linewidths=1.5)


def _draw_vectors(labels: MotionLabels, name: DrawnMap, frame: int, ax: Axes) -> None:
    vectors, known = _devkit_map(labels, name, frame), _known(labels, name, frame)
    colors = _direction_colors(*vectors, longest=_longest(labels, name))
    _draw_cells(ax, np.where(known[..., None], colors, 1.0), labels)
    if name == "flow" and known.any():
        _draw_arrows(_devkit_map(labels, "instance", frame), vectors, known, labels, ax)


def _draw_arrows(instance: AnyArray, flow: AnyArray, known: BoolArray, labels: MotionLabels, ax: Axes) -> None:
    """An arrow an instance, from the mean of its cells (H, W), as long as its flow (2, H, W)."""
    row, column = np.nonzero(known)
    _, first, member, count = np.unique(instance[known], return_index=True, return_inverse=True, return_counts=True)
    x, y = _cell_centers(labels)
    start = [np.bincount(member.ravel(), weights=values) / count for values in (x[column], y[row])]
    down, along = flow[:, known][:, first]  # the same on all cells of an instance
    steps = along * labels.config.grid.x[2], down * labels.config.grid.y[2]
    ax.quiver(*start, *steps, angles="xy", scale_units="xy", scale=1, width=0.007, headlength=4, zorder=3)


def _draw_cells(ax: Axes, picture: AnyArray, labels: MotionLabels, **how: Any) -> None:
    extent = (*labels.config.grid.x[:2], *labels.config.grid.y[:2])
    ax.imshow(picture, origin="lower", extent=extent, interpolation="nearest", **how)


def _draw_key(name: DrawnMap, longest: float, ax: Axes) -> None:
    """What the colours of a map mean."""
    ax.axis("off")
    if name == "instance":
        from matplotlib.patches import Patch

        handles = [
            Patch(label="colliding pair", facecolor=COLLIDER_COLOR),
            Patch(label="own box", facecolor="none", edgecolor=OWN_COLOR, linewidth=1.5),
        ]
        ax.legend(handles=handles, loc="center left", frameon=False, borderpad=0, handlelength=1)
    elif name == "centerness":
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        ax.figure.colorbar(ScalarMappable(Normalize(0, 1), "magma"), cax=ax.inset_axes((0.1, 0.15, 0.15, 0.7)))
    else:
        side = np.linspace(-1, 1, 101)
        along, down = np.meshgrid(side, side)
        colors = _direction_colors(down, along, longest=1.0)
        wheel = np.where((np.hypot(down, along) <= 1)[..., None], colors, 1.0)
        ax.imshow(wheel, origin="lower", extent=(-1, 1, -1, 1))
        ax.text(0, -1.2, f"rim: {longest:.0f} cells", ha="center", va="top")
        ax.text(0, 1.1, "left", ha="center", va="bottom")
        ax.text(1.1, 0, "forward", ha="left", va="center", rotation=270)


def _direction_colors(down: AnyArray, along: AnyArray, *, longest: float) -> AnyArray:
    """(H, W, 3) a colour for the direction of vectors of the devkit's orientation, paler for shorter ones."""
    from matplotlib.colors import hsv_to_rgb

    hue = (np.arctan2(down, along) / (2 * np.pi)) % 1
    strength = np.minimum(np.hypot(down, along) / longest, 1)
    return hsv_to_rgb(np.stack([hue, strength, np.full(hue.shape, 0.92)], axis=-1))


def _instance_colors(labels: MotionLabels, marked: Collection[int]) -> FloatArray:
    """(1 + ids, 3) white for the background, a colour of the palette for each id, red and green for some actors."""
    from matplotlib import colormaps
    from matplotlib.colors import to_rgb

    highest = max([int(labels.instance[labels.label_valid].max(initial=0)), *labels.id_map.values()])
    palette = colormaps["tab20"]
    colors = np.array([palette(_PALETTE[number % len(_PALETTE)])[:3] for number in range(1 + highest)])
    colors[0] = 1.0
    for actor, identity in labels.id_map.items():
        own = actor == OWN_BOX_ID
        if (OWN_ACTOR_ID if own else actor) in marked:
            colors[identity] = to_rgb(COLLIDER_COLOR)
        elif own:
            colors[identity] = to_rgb(OWN_COLOR)
    return colors


def _devkit_map(labels: MotionLabels, name: DrawnMap, frame: int) -> AnyArray:
    """One frame's map with rows along y (left) and columns along x (forward); vectors likewise."""
    return to_orientation(
        getattr(labels, name)[frame],
        vectors=name in ("offset", "flow"),
        source=labels.config.grid.orientation,
        target="devkit",
        ignore=labels.config.ignore_index,
    )


def _known(labels: MotionLabels, name: DrawnMap, frame: int) -> BoolArray:
    """(H, W) where there is an instance with a vector, the devkit's way up."""
    known: BoolArray = (_devkit_map(labels, name, frame) != labels.config.ignore_index).any(axis=0)
    known &= _devkit_map(labels, "instance", frame) != 0
    return known


def _longest(labels: MotionLabels, name: DrawnMap) -> float:
    """Cells, at least 1: the longest vector of a map in all recorded frames."""
    if name not in ("offset", "flow"):
        return 1.0
    recorded = np.flatnonzero(labels.label_valid).tolist()
    lengths = [np.hypot(*_devkit_map(labels, name, frame))[_known(labels, name, frame)] for frame in recorded]
    return max(1.0, *(float(length.max(initial=0)) for length in lengths))


def _cell_centers(labels: MotionLabels) -> tuple[FloatArray, FloatArray]:
    """Metres x of the columns' and y of the rows' middles, the devkit's way up."""
    grid = labels.config.grid.with_orientation("devkit")
    centers = grid.centers()
    return centers[0, :, 0], centers[:, 0, 1]
