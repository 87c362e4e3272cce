"""The effects of a link on shared data: where partners' boxes arrive, and the clouds with and without the link."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.render.bev import BevView, draw_bev, link_words
from deepaccident_devkit.render.boxes import draw_boxes_from_above, draw_ids_from_above
from deepaccident_devkit.render.captions import draw_legend, set_scene_title
from deepaccident_devkit.render.chips import keep_free
from deepaccident_devkit.render.figures import (
    Layer,
    check_view_range,
    figure_or_new,
    layers_of,
    settled,
    with_light_grid,
)
from deepaccident_devkit.render.styles import AGENT_COLORS, MUTED_COLOR, OWN_COLOR, TRUE_PLACE_COLOR, in_own_settings
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.taxonomy import UNTRACKED_ID, short_name
from deepaccident_devkit.v2x import Agents, Link, cooperating_agents, cooperative_boxes

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LAYERS: Final[tuple[Layer, ...]] = ("points", "boxes", "ids", "grid")
_SHOWN: Final[tuple[Layer, ...]] = ("points", "boxes", "grid")


_DASHED: Final = (0, (2, 1))
_RECEIVER: Final[Mapping[str, Any]] = {
    "linestyle": "none",
    "marker": "*",
    "color": OWN_COLOR,
    "markersize": 8,
    "zorder": 5,
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SharedBoxes:
    """What a partner shares of the actors that it annotated, in the ego frame of the receiver.

    Attributes:
        agent: the partner.
        true: the boxes of its label at the present, at their true places.
        received: the boxes that arrive, where the receiver places them; none if the message is lost.
    """

    agent: str
    true: Boxes
    received: Boxes

    @property
    def shifts(self) -> tuple[FloatArray, FloatArray]:
        """(M, 2) true and (M, 2) received centres, x and y, of the actors that are in both."""
        _, first, second = np.intersect1d(self.true.actor_id, self.received.actor_id, return_indices=True)
        return self.true.center[first, :2], self.received.center[second, :2]


@in_own_settings
def render_link(
    dataset: Dataset,
    sample: RowArgument,
    link: Link,
    *,
    agents: Agents = None,
    view_range: float = 50.0,
    layers: Iterable[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render the effects of latency, wrong poses and losses on the data that partners share with a sample's agent.

    Each partner has a panel with its boxes: dashed at their true places, in the partner's hue at the received places,
    with arrows between these places and the metres in its title. The last panels have the agents' clouds, without the
    link and with it.

    Args:
        dataset: the release.
        sample: token or record: its agent receives.
        link: what happens to the partners' data.
        agents: which agents cooperate: names, a configuration or its name as seen from the ego; None for all that are
            there.
        view_range: metres shown to each side of the ego.
        layers: `points`, `boxes` and `grid` are the default; also `ids`. Without `points` there are no clouds.
        fig: an empty figure to render on; a new one if None.

    Returns:
        The figure, in metres of the sample's ego frame.

    Raises:
        TokenError: no such sample.
        ChoiceError: no such agent, configuration or layer, no partner among the agents, or `view_range` is not above 0.
        NotAvailableError: an agent is not in this (partial) release.
        ConfigError: `link` is no Link, or its latency is longer than the scenario's past.
    """
    shown = layers_of(layers, _SHOWN, _LAYERS)
    check_view_range(view_range)
    shared = shared_boxes(dataset, sample, link, agents)
    clouds = {"without the link": None, "with the link": link} if "points" in shown else {}
    rows = min(2, len(shared))
    columns = -(-len(shared) // rows)
    fig = figure_or_new(fig, (4.2 * (columns + -(-len(clouds) // rows)) + 0.4, 4.4 * rows + 1.1))
    axes = fig.subplots(rows, columns + -(-len(clouds) // rows), squeeze=False)
    panels = [*axes[:, :columns].flat, *axes[:, columns:].flat]
    for ax in panels[len(shared) : rows * columns]:
        ax.set_axis_off()
    for each, ax in zip(shared, panels, strict=False):
        ax.set(xlim=(-view_range, view_range), ylim=(-view_range, view_range), aspect="equal")
        ax.set(xlabel="x forward (m)", ylabel="y left (m)")
        ax.set_title(_shift_words(each), fontsize="medium")
        _draw_shared(each, shown, ax)
    for ax, (words, there) in zip(panels[rows * columns :], clouds.items(), strict=True):
        view = BevView(view_range=view_range, agents=agents, link=there)
        draw_bev(dataset, sample, view, shown - {"boxes", "ids"}, ax)
        ax.set_title(f"clouds {words}", fontsize="medium")
        ax.set_anchor("C")
        if "boxes" in shown:
            truth = cooperative_boxes(dataset, sample, agents=agents, frame="ego")
            draw_boxes_from_above(truth, ax, [OWN_COLOR] * len(truth), fill=0.0, linewidths=0.7)
    draw_legend(fig, _handles(), columns=4)
    token = dataset.get("sample", sample)["token"]
    set_scene_title(fig, dataset, token, below=link_words(link), fontsize=11)
    return settled(fig)


def shared_boxes(dataset: Dataset, sample: RowArgument, link: Link, agents: Agents = None) -> list[SharedBoxes]:
    """Each partner's tracked boxes as they arrive; arguments and errors as in `render_link`."""
    record = dataset.get("sample", sample)
    partners = [agent for agent in cooperating_agents(dataset, sample, agents) if agent != record["agent"]]
    if not partners:
        raise ChoiceError(f"agents: expected a partner of {record['agent']}, found none; a link needs two agents")
    return [
        SharedBoxes(
            agent=agent,
            true=_tracked(cooperative_boxes(dataset, sample, agents=[agent], frame="ego")),
            received=_tracked(cooperative_boxes(dataset, sample, agents=[agent], frame="ego", link=link)),
        )
        for agent in partners
    ]


def _tracked(boxes: Boxes) -> Boxes:
    return boxes.select(boxes.actor_id != UNTRACKED_ID)


def _draw_shared(shared: SharedBoxes, shown: frozenset[Layer], ax: Axes) -> None:
    """Render a partner's boxes, and how far they are from their places."""
    ax.plot(0, 0, **_RECEIVER)
    keep_free(ax, [[(0.0, 0.0)]], margin=(-5, -5, 5, 5))
    colors = [AGENT_COLORS[shared.agent]] * len(shared.received)
    if "boxes" in shown:
        true = [TRUE_PLACE_COLOR] * len(shared.true)
        draw_boxes_from_above(shared.true, ax, true, fill=0, linestyle=_DASHED, linewidths=1)
        draw_boxes_from_above(shared.received, ax, colors, fill=0.4, linewidths=1.2)
    start, end = shared.shifts
    if len(start):
        how: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.006, "zorder": 4}
        ax.quiver(*start.T, *(end - start).T, color=OWN_COLOR, **how)
    if "ids" in shown:
        draw_ids_from_above(shared.received, ax, colors)
    if "grid" in shown:
        with_light_grid(ax, "both")


def _handles() -> list[Artist]:
    """What the marks of the partners' panels mean."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    return [
        Line2D([], [], label="receiver", **_RECEIVER),
        Patch(facecolor="none", edgecolor=TRUE_PLACE_COLOR, linestyle="--", label="where they truly are"),
        Patch(facecolor=(MUTED_COLOR, 0.4), edgecolor=MUTED_COLOR, label="where they arrive, in the partner's hue"),
        Line2D([], [], linestyle="none", marker="$\\rightarrow$", color=OWN_COLOR, markersize=12, label="the error"),
    ]


def _shift_words(shared: SharedBoxes) -> str:
    name = short_name(shared.agent)
    if not len(shared.received) and len(shared.true):
        return f"{name}: nothing arrived"
    start, end = shared.shifts
    if not len(start):
        return f"{name}: no box in common"
    apart = np.linalg.norm(end - start, axis=1)
    return f"{name}: {len(apart)} boxes\noff by {apart.mean():.2f} m\n(at most {apart.max():.2f} m)"
