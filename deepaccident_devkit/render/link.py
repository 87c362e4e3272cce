"""The effects of a link on shared data: received boxes, and clouds with and without the link."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.geometry.boxes import concatenate
from deepaccident_devkit.render.bev import BevView, draw_bev, link_words
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
    check_view_range,
    figure_or_new,
    label_axes,
    layers_of,
    settled,
    widening,
    with_light_grid,
)
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    OWN_COLOR,
    TRUE_PLACE_COLOR,
    current_style,
    in_own_settings,
)
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.taxonomy import UNTRACKED_ID, short_name
from deepaccident_devkit.v2x import Agents, Link, cooperating_agents, cooperative_boxes, transform
from deepaccident_devkit.v2x.messages import messages

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from deepaccident_devkit.tables.records import SampleRecord

_LINK_LAYERS: Final[tuple[Layer, ...]] = ("points", "boxes", "ids", "grid")
_DEFAULT_LAYERS: Final[tuple[Layer, ...]] = ("points", "boxes", "grid")
# Metres around the agents and the pair.
_VIEW_MARGIN_M: Final = 8.0
# Metres shown to each side: minimum and maximum.
_VIEW_RANGE_LIMITS_M: Final = (25.0, 60.0)
_TRUE_LINE_STYLE: Final = (0, (2, 1))
_RECEIVER_STYLE: Final[Mapping[str, Any]] = {
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
        true: Present boxes of its label, at their true positions.
        received: Received boxes, at the receiver's positions; none if the message is lost.
    """

    agent: str
    true: Boxes
    received: Boxes

    @property
    def shifts(self) -> tuple[FloatArray, FloatArray]:
        """True and received centres of the actors in both, x and y, shape (M, 2) each."""
        _, true_rows, received_rows = np.intersect1d(
            self.true.actor_id, self.received.actor_id, return_indices=True
        )
        return self.true.center[true_rows, :2], self.received.center[received_rows, :2]


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

    The first panel has all partners' boxes: dashed at their true positions, and in each partner's
    hue as received, with arrows between these positions; the legend has the mean distances. The
    other panels have the agents' clouds without the link and with it, in papers and on slides only
    with it, and in a paper's column there are none.

    Args:
        dataset: The release.
        sample: Token or record: its agent receives.
        link: Effects on the partners' data.
        agents: Cooperating agents: names, a configuration or its name from the view of the ego;
            None for all present agents.
        view_range: Metres shown to each side of the ego; None shows all agents and the colliding
            pair.
        layers: `points`, `boxes` and `grid` are the default; also `ids`. Without `points` there are
            no clouds.
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
    # the legend is below, so a slide's panel is wider
    width_ratio = 1.0 if links else widening(None) ** 1.5
    half_width = width_ratio * view_range
    box_ax.set(xlim=(-half_width, half_width), ylim=(-view_range, view_range), aspect="equal")
    label_axes(box_ax, "ego")
    box_ax.set_title(_error_words(shared))
    _draw_shared(shared, shown_layers, box_ax)
    words = f"{short_name(record['agent'])} receives"
    write_beside(box_ax, words, (0.0, 0.0), AGENT_COLORS[record["agent"]])
    for ax, (words, cloud_link) in zip(cloud_axes, links.items(), strict=True):
        view = BevView(view_range=view_range, agents=agents, link=cloud_link)
        draw_bev(dataset, record, view, shown_layers - {"boxes", "ids"}, ax)
        ax.set(title=f"clouds {words}", anchor="C")
        if "boxes" in shown_layers:
            truth = cooperative_boxes(dataset, record, agents=agents, frame="ego")
            draw_boxes_from_above(truth, ax, [OWN_COLOR] * len(truth), fill=0.0, linewidths=0.7)
    draw_legend(fig, [*map(_handle, shared), *_handles()], columns=4)
    set_scene_title(fig, dataset, record["token"], below=link_words(link))
    return settled(fig)


def _links_of_clouds(link: Link, layers: frozenset[Layer]) -> dict[str, Link | None]:
    """Return the words for each panel of clouds → its link."""
    if "points" not in layers or current_style().room == "column":
        return {}
    if current_style().few:
        return {"with the link": link}
    return {"without the link": None, "with the link": link}


def _panels(fig: Figure | None, clouds: int) -> tuple[Figure, Axes, list[Axes]]:
    """Return the figure, the axes of the boxes, and the axes of the clouds."""
    size = 5.0 * (1 + clouds) + 0.4, 6.4
    if clouds:
        fig = figure_or_new(fig, size, panels="several", page=0.6, column=1.28)
    else:
        fig = figure_or_new(fig, size, panels="one", page=1.28, column=1.28)
    box_ax, *cloud_axes = fig.subplots(1, 1 + clouds, squeeze=False)[0]
    return fig, box_ax, cloud_axes


def _view_range(dataset: Dataset, record: SampleRecord, shared: Sequence[SharedBoxes]) -> float:
    """Return metres to each side of the ego up to the agents and the colliding pair.

    They are within limits.
    """
    colliders = [*collider_ids(dataset, record)]
    positions, pair_centers = [], []
    for boxes in shared:
        sample = simultaneous_sample(record, boxes.agent)
        pose = transform(dataset, record, sample, "ego", "ego")
        pair = boxes.true.select(np.isin(boxes.true.actor_id, colliders))
        positions.append(pose.translation[:2])
        pair_centers.append(pair.center[:, :2])
    points = np.concatenate([np.array(positions), *pair_centers])
    view_range = np.abs(points).max() + _VIEW_MARGIN_M
    return float(np.clip(view_range, *_VIEW_RANGE_LIMITS_M))


def shared_boxes(
    dataset: Dataset, sample: RowArgument, link: Link, agents: Agents = None
) -> list[SharedBoxes]:
    """Return each partner's tracked boxes as received; arguments and errors as in `render_link`."""
    record = dataset.get("sample", sample)
    names = cooperating_agents(dataset, sample, agents)
    partners = [agent for agent in names if agent != record["agent"]]
    if not partners:
        raise ChoiceError(
            f"agents: expected a partner of {record['agent']}, found none; a link needs two agents"
        )
    # all messages are sent together, since together they may not fit the link
    senders = {message.agent for message in messages(dataset, sample, agents, link)}
    shared = []
    for agent in partners:
        agent_link = link if agent in senders else replace(link, packet_loss=1.0)
        true = cooperative_boxes(dataset, sample, agents=[agent], frame="ego")
        received = cooperative_boxes(dataset, sample, agents=[agent], frame="ego", link=agent_link)
        shared.append(SharedBoxes(agent=agent, true=_tracked(true), received=_tracked(received)))
    return shared


def _tracked(boxes: Boxes) -> Boxes:
    return boxes.select(boxes.actor_id != UNTRACKED_ID)


def _draw_shared(shared: Sequence[SharedBoxes], layers: frozenset[Layer], ax: Axes) -> None:
    """Draw partners' boxes, with arrows from their true positions."""
    ax.plot(0, 0, **_RECEIVER_STYLE)
    keep_free(ax, [[(0.0, 0.0)]], margin=(-5, -5, 5, 5))
    true = concatenate([boxes.true for boxes in shared], "ego")
    true = true.select(np.unique(true.actor_id, return_index=True)[1])
    true_colors = [TRUE_PLACE_COLOR] * len(true)
    if "boxes" in layers:
        draw_boxes_from_above(
            true, ax, true_colors, fill=0, linestyle=_TRUE_LINE_STYLE, linewidths=1
        )
    for boxes in shared:
        colors = [AGENT_COLORS[boxes.agent]] * len(boxes.received)
        if "boxes" in layers:
            draw_boxes_from_above(boxes.received, ax, colors, fill=0.25, linewidths=1)
        starts, ends = boxes.shifts
        if len(starts):
            ax.quiver(*starts.T, *(ends - starts).T, color=OWN_COLOR, **ARROW_STYLE)
    if "ids" in layers:
        draw_ids_from_above(true, ax, true_colors)
    if "grid" in layers:
        with_light_grid(ax, "both")


def _handle(shared: SharedBoxes) -> Artist:
    """Return the handle of a partner: its hue, and the mean shift of its boxes."""
    from matplotlib.patches import Patch

    color = AGENT_COLORS[shared.agent]
    return Patch(facecolor=(color, 0.25), edgecolor=color, label=_shift_words(shared))


def _handles() -> list[Artist]:
    """Return handles of the other marks of the first panel."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    return [
        Patch(facecolor="none", edgecolor=TRUE_PLACE_COLOR, linestyle="--", label="true places"),
        Line2D(
            [],
            [],
            linestyle="none",
            marker="$\\rightarrow$",
            color=OWN_COLOR,
            markersize=12,
            label="the error",
        ),
    ]


def _shift_words(shared: SharedBoxes) -> str:
    name = short_name(shared.agent)
    if not len(shared.received) and len(shared.true):
        return f"{name}: nothing arrived"
    starts, ends = shared.shifts
    if not len(starts):
        return f"{name}: no box in common"
    distances = np.linalg.norm(ends - starts, axis=1)
    return f"{name}: {distances.mean():.2f} m"


def _error_words(shared: Sequence[SharedBoxes]) -> str:
    """Return the title of all partners' boxes."""
    distances = [np.linalg.norm(np.subtract(*boxes.shifts), axis=1) for boxes in shared]
    return f"boxes, off by at most {np.concatenate(distances).max(initial=0):.2f} m"
