"""The effects of a link on shared data: boxes and clouds as recorded and as received."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.geometry.boxes import concatenate
from deepaccident_devkit.render.bev import BevView, draw_bev, draw_road, link_words
from deepaccident_devkit.render.boxes import (
    ARROW_STYLE,
    collider_ids,
    draw_boxes_from_above,
    draw_ids_from_above,
    simultaneous_sample,
    write_beside,
)
from deepaccident_devkit.render.captions import draw_legend, set_scene_title
from deepaccident_devkit.render.chips import keep_free
from deepaccident_devkit.render.figures import (
    Layer,
    Layers,
    check_view_range,
    figure_or_new,
    label_axes,
    lay_out_figure,
    layers_of,
    show_square,
    square_around,
    width_to_height,
    with_light_grid,
)
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    CASING_COLOR,
    MUTED_COLOR,
    OWN_COLOR,
    TRUE_PLACE_COLOR,
    current_style,
    in_own_settings,
)
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.support.values import ReadOnlyValues
from deepaccident_devkit.taxonomy import UNTRACKED_ID, short_name
from deepaccident_devkit.v2x import Agents, Link, cooperating_agents, cooperative_boxes, transform
from deepaccident_devkit.v2x.messages import messages

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from deepaccident_devkit.tables.records import SampleRecord

_LINK_LAYERS: Layers = ("bev", "points", "boxes", "ids", "grid")
_DEFAULT_LAYERS: Layers = ("bev", "points", "boxes", "grid")
# Metres shown around the agents and the pair.
_VIEW_MARGIN_M = 8.0
# Minimum and maximum number of metres shown to each side.
_VIEW_RANGE_LIMITS_M = (25.0, 60.0)
# Side of the magnified part over the height of its panel, and the minimum magnification for which
# it is shown.
_INSET_SHARE = 0.36
_MIN_MAGNIFICATION = 1.5
# Letters of the magnified parts, and the smallest error that is magnified.
_INSET_LETTERS = "AB"
_MIN_MAGNIFIED_ERROR_M = 0.01
_LETTER_BACKGROUND = {"facecolor": CASING_COLOR, "edgecolor": "none", "alpha": 0.7, "pad": 0.5}
# Metres shown around the two positions of a magnified box.
_MAGNIFIED_MARGIN_M = 3.5
_TRUE_LINE_STYLE = (0, (2, 1))
# Arrows are equally wide in the panel and in its magnified part.
_ARROW_STYLE = {**ARROW_STYLE, "units": "inches", "width": 0.014}
_RECEIVER_STYLE: ReadOnlyValues = {
    "linestyle": "none",
    "marker": "*",
    "color": OWN_COLOR,
    "markersize": 7,
    "zorder": 5,
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SharedBoxes:
    """The boxes of the actors that a partner annotated, in the ego frame of the receiver.

    Attributes:
        agent: Name of the partner.
        true: Boxes of the partner's label in the current frame, at their true positions.
        received: Boxes where the receiver places them; empty if the message is lost.
    """

    agent: str
    true: Boxes
    received: Boxes

    @property
    def shifts(self) -> tuple[FloatArray, FloatArray]:
        """True and received centres of the M received actors, x and y, shape (M, 2) each."""
        _, true_rows, received_rows = np.intersect1d(
            self.true.actor_id, self.received.actor_id, return_indices=True
        )
        true_centers = self.true.center[true_rows, :2]
        received_centers = self.received.center[received_rows, :2]
        return true_centers, received_centers


@in_own_settings
def render_link(
    dataset: Dataset,
    sample: RowArgument,
    link: Link,
    *,
    agents: Agents = None,
    view_range: float | None = None,
    layers: Iterable[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render the effects of latency, wrong poses and losses on the data that partners share.

    The first panel shows all partners' boxes, dashed at their true positions, and in the partner's
    hue as received. Arrows lead from the true to the received positions; the legend states the mean
    distances, and corners show the two boxes with the largest errors magnified. The other panels
    show the agents' clouds, as recorded and as received; in papers and on slides only as received,
    and in a paper's column not at all.

    Args:
        dataset: The release.
        sample: Token or record; its agent is the receiver.
        link: Effects on the partners' data.
        agents: Cooperating agents: names, a configuration or its name from the view of the ego;
            None for all present agents.
        view_range: Metres shown to each side of the ego; None shows all agents and the colliding
            pair.
        layers: Any of `bev` (the road, if a BEV camera's picture or a town map is present),
            `points`, `boxes`, `grid` (these are the default) and `ids`. Without `points`, no panel
            shows clouds.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure, in metres of the sample's ego frame.

    Raises:
        TokenError: No such sample.
        ChoiceError: No such agent, configuration or layer, no partner among the agents, or
            `view_range` is not above 0.
        NotAvailableError: An agent is not in this (partial) release.
        ConfigError: `link` is no Link, or its latency is longer than the scenario's past.
    """
    shown_layers = layers_of(layers, _DEFAULT_LAYERS, _LINK_LAYERS)
    record = dataset.sample[dataset.getind("sample", sample)]
    if view_range is not None:
        check_view_range(view_range)
    shared = shared_boxes(dataset, record, link, agents)
    view_range = view_range or _view_range(dataset, record, shared)
    links = _links_of_clouds(link, shown_layers)
    fig, box_ax, cloud_axes = _panels(fig, len(links))
    # the legend is below, so a wide style's panel is wider
    width_ratio = 1.0 if links else width_to_height(None) ** 1.5
    half_width = width_ratio * view_range
    box_ax.set(xlim=(-half_width, half_width), ylim=(-view_range, view_range), aspect="equal")
    label_axes(box_ax, "ego")
    box_ax.locator_params(nbins=6)  # each tick costs time
    box_ax.set_title("Box positions (mean errors in the legend)")
    _draw_shared(shared, shown_layers, box_ax)
    insets = _magnify_largest_errors(shared, box_ax) if "boxes" in shown_layers else []
    words = f"received by {short_name(record['agent'])}"
    write_beside(box_ax, words, (0.0, 0.0), AGENT_COLORS[record["agent"]])
    for ax, (words, cloud_link) in zip(cloud_axes, links.items(), strict=True):
        view = BevView(view_range=view_range, agents=agents, link=cloud_link)
        draw_bev(dataset, record, view, shown_layers & {"points", "grid"}, ax)
        ax.set(title=f"Point clouds {words}", anchor="C")
        if "boxes" in shown_layers:
            truth = cooperative_boxes(dataset, record, agents=agents, frame="ego")
            draw_boxes_from_above(truth, ax, [OWN_COLOR] * len(truth), fill=0.0, linewidths=0.7)
    if "bev" in shown_layers:
        target_from_world = dataset.world_from(record, "ego").inverse()
        axes = [box_ax, *insets, *cloud_axes]
        draw_road(dataset, record["frame_token"], axes, target_from_world=target_from_world)
    draw_legend(fig, _legend_handles(shared), columns=4)
    set_scene_title(fig, dataset, record["token"], below=link_words(link))
    return lay_out_figure(fig)


def _links_of_clouds(link: Link, layers: frozenset[Layer]) -> dict[str, Link | None]:
    """Return the link of each panel that shows clouds, by the panel's title."""
    if "points" not in layers or current_style().layout == "column":
        return {}
    if current_style().shows_few_panels:
        return {"as received": link}
    return {"as recorded": None, "as received": link}


def _panels(fig: Figure | None, clouds: int) -> tuple[Figure, Axes, list[Axes]]:
    """Return the figure, the axes for the boxes, and the axes for the clouds."""
    page_height = 0.6 if clouds or current_style().is_wide else 1.3
    fig = figure_or_new(
        fig,
        (5.0 * (1 + clouds) + 0.4, 6.4),
        panels="several" if clouds else "one",
        page=page_height,
        column=1.3,
    )
    box_ax, *cloud_axes = fig.subplots(1, 1 + clouds, squeeze=False)[0]
    return fig, box_ax, cloud_axes


def _view_range(dataset: Dataset, record: SampleRecord, shared: Sequence[SharedBoxes]) -> float:
    """Return the view range, in metres, that shows the agents and the colliding pair.

    It is within `_VIEW_RANGE_LIMITS_M`.
    """
    colliders = [*collider_ids(dataset, record)]
    points = []
    for boxes in shared:
        sample = simultaneous_sample(record, boxes.agent)
        pose = transform(dataset, record, sample, "ego", "ego")
        pair = boxes.true.select(np.isin(boxes.true.actor_id, colliders))
        points += [pose.translation[None, :2], pair.center[:, :2]]
    view_range = np.abs(np.concatenate(points)).max() + _VIEW_MARGIN_M
    return float(np.clip(view_range, *_VIEW_RANGE_LIMITS_M))


def shared_boxes(
    dataset: Dataset, sample: RowArgument, link: Link, agents: Agents = None
) -> list[SharedBoxes]:
    """Return each partner's tracked boxes, at their true positions and as received.

    Arguments and errors are as for `render_link`.
    """
    record = dataset.get("sample", sample)
    names = cooperating_agents(dataset, sample, agents)
    partners = [agent for agent in names if agent != record["agent"]]
    if not partners:
        raise ChoiceError(
            f"agents: expected a partner of {record['agent']}, found none; a link needs two agents"
        )
    # all messages are sent together, because together they may exceed the link's capacity
    senders = {message.agent for message in messages(dataset, sample, agents, link)}
    shared = []
    for agent in partners:
        agent_link = link
        if agent not in senders:
            agent_link = replace(link, packet_loss=1.0)
        true = cooperative_boxes(dataset, sample, agents=[agent], frame="ego")
        true = true.select(true.actor_id != UNTRACKED_ID)
        received = cooperative_boxes(dataset, sample, agents=[agent], frame="ego", link=agent_link)
        received = received.select(received.actor_id != UNTRACKED_ID)
        shared.append(SharedBoxes(agent=agent, true=true, received=received))
    return shared


def _draw_shared(shared: Sequence[SharedBoxes], layers: frozenset[Layer], ax: Axes) -> None:
    """Draw partners' boxes, with arrows from their true positions."""
    ax.plot(0, 0, **_RECEIVER_STYLE)
    keep_free(ax, [[(0.0, 0.0)]], margin=(-5, -5, 5, 5))
    true = concatenate([boxes.true for boxes in shared], "ego")
    _, first_rows = np.unique(true.actor_id, return_index=True)
    true = true.select(first_rows)
    true_colors = [TRUE_PLACE_COLOR] * len(true)
    if "boxes" in layers:
        draw_boxes_from_above(
            true, ax, true_colors, fill=0, linestyle=_TRUE_LINE_STYLE, linewidths=1
        )
    for boxes in shared:
        colors = [AGENT_COLORS[boxes.agent]] * len(boxes.received)
        if "boxes" in layers:
            # filled boxes of several partners would mix to brown
            draw_boxes_from_above(boxes.received, ax, colors, fill=0, linewidths=1.4)
        starts, ends = boxes.shifts
        if len(starts):
            shifts = ends - starts
            ax.quiver(*starts.T, *shifts.T, color=OWN_COLOR, **_ARROW_STYLE)
    if "ids" in layers:
        draw_ids_from_above(true, ax, true_colors)
    if "grid" in layers:
        with_light_grid(ax, "both")


def _magnify_largest_errors(shared: Sequence[SharedBoxes], ax: Axes) -> list[Axes]:
    """Magnify the two visible boxes with the largest errors; return the axes of these parts.

    They are in the corners with the fewest boxes. A box that the first part shows is not magnified
    again. There is no magnified part for a box without an error, or if it would hardly be larger.
    """
    shifts = np.concatenate([np.stack(boxes.shifts, axis=1) for boxes in shared])
    low, high = np.array([ax.get_xlim(), ax.get_ylim()]).T
    is_visible = ((low < shifts) & (shifts < high)).all(axis=(1, 2))
    shifts = shifts[is_visible]
    side = _INSET_SHARE * (high[1] - low[1])
    corners = low + (high - low - side) * np.array([(0, 0), (1, 0), (0, 1), (1, 1)])
    is_covered = np.abs(shifts.reshape(-1, 2) - corners[:, None] - side / 2) < side / 2
    num_covered = is_covered.all(axis=2).sum(axis=1)
    insets = []
    for letter in _INSET_LETTERS:
        distances = np.linalg.norm(shifts[:, 1] - shifts[:, 0], axis=1)
        if distances.max(initial=0.0) < _MIN_MAGNIFIED_ERROR_M:
            break
        center, half = square_around(shifts[distances.argmax()], _MAGNIFIED_MARGIN_M)
        magnification = side / (2 * half)
        if magnification < _MIN_MAGNIFICATION:
            break
        corner_distances = np.linalg.norm(corners + side / 2 - center, axis=1)
        best = np.lexsort((corner_distances, num_covered))[0]
        inset = _magnify(shared, ax, corners[best], center=center, half=half)
        # letters, because lines from the parts to their places would cross
        words = f"{letter}: {distances.max():.2f} m, ×{magnification:.0f}"
        left, top = center + half * np.array([-1, 1])
        for text_ax, text in ((inset, words), (ax, letter)):
            text_ax.annotate(
                text,
                (left, top),
                xytext=(3, -3),
                textcoords="offset points",
                ha="left",
                va="top",
                bbox=_LETTER_BACKGROUND,
                zorder=6,
            )
        insets.append(inset)
        is_magnified = (np.abs(shifts - center) < half).all(axis=(1, 2))
        shifts = shifts[~is_magnified]
        corners = np.delete(corners, best, axis=0)
        num_covered = np.delete(num_covered, best)
    return insets


def _magnify(
    shared: Sequence[SharedBoxes], ax: Axes, corner: FloatArray, *, center: FloatArray, half: float
) -> Axes:
    """Draw the square around `center` magnified, with its lower left at `corner`, metres."""
    low, high = ax.viewLim.get_points()
    side = _INSET_SHARE * (high[1] - low[1])
    inset = ax.inset_axes((*(corner - low) / (high - low), *side / (high - low)))
    show_square(inset, center, half)
    inset.set(xticks=[], yticks=[], in_layout=False)  # it is within its panel
    _draw_shared(shared, frozenset({"boxes"}), inset)
    ax.indicate_inset((*(center - half), 2 * half, 2 * half), edgecolor=MUTED_COLOR, alpha=1.0)
    keep_free(ax, [[corner, corner + side], [center - half, center + half]])
    return inset


def _legend_handles(shared: Sequence[SharedBoxes]) -> list[Artist]:
    """Make a legend handle for each partner, with its boxes' mean shift, and for other marks."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Artist] = []
    for boxes in shared:
        color = AGENT_COLORS[boxes.agent]
        handles.append(Patch(facecolor="none", edgecolor=color, label=_shift_words(boxes)))
    handles.append(
        Patch(facecolor="none", edgecolor=TRUE_PLACE_COLOR, linestyle="--", label="ground truth")
    )
    handles.append(
        Line2D(
            [],
            [],
            linestyle="none",
            marker="$\\rightarrow$",
            color=OWN_COLOR,
            markersize=12,
            label="displacement",
        )
    )
    return handles


def _shift_words(shared: SharedBoxes) -> str:
    """State the mean distance between a partner's true and received boxes in words."""
    name = short_name(shared.agent)
    if not len(shared.received) and len(shared.true):
        return f"{name}: nothing arrived"
    starts, ends = shared.shifts
    if not len(starts):
        return f"{name}: no box in common"
    distances = np.linalg.norm(ends - starts, axis=1)
    mean_distance = distances.mean()
    return f"{name}: {mean_distance:.2f} m"
