"""The effects of a link on shared data: where partners' boxes arrive, and the clouds with and without the link."""

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
    at_once,
    collider_ids,
    draw_boxes_from_above,
    draw_ids_from_above,
    write_beside,
)
from deepaccident_devkit.render.captions import draw_legend, set_scene_title
from deepaccident_devkit.render.chips import keep_free
from deepaccident_devkit.render.figures import (
    Layer,
    axis_words,
    check_view_range,
    figure_or_new,
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

_LAYERS: Final[tuple[Layer, ...]] = ("points", "boxes", "ids", "grid")
_SHOWN: Final[tuple[Layer, ...]] = ("points", "boxes", "grid")


# Metres around the agents and the pair.
_AROUND: Final = 8.0
# Metres to each side that are shown at least and at most.
_REACHES: Final = (25.0, 60.0)
_DASHED: Final = (0, (2, 1))
_RECEIVER: Final[Mapping[str, Any]] = {
    "linestyle": "none",
    "marker": "*",
    "color": OWN_COLOR,
    "markersize": 7,
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
        _, first, second = np.intersect1d(
            self.true.actor_id, self.received.actor_id, return_indices=True
        )
        return self.true.center[first, :2], self.received.center[second, :2]


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
    """Render the effects of latency, wrong poses and losses on the data that partners share with a sample's agent.

    The first panel has all partners' boxes: dashed at their true places, in each partner's hue where they arrive, with
    arrows between these places; the legend says how far that is on average. The other panels have the agents' clouds
    without the link and with it, in papers and on slides only with it, and in a paper's column there are none.

    Args:
        dataset: the release.
        sample: token or record: its agent receives.
        link: what happens to the partners' data.
        agents: which agents cooperate: names, a configuration or its name as seen from the ego; None for all that are
            there.
        view_range: metres shown to each side of the ego; None shows all agents and the colliding pair.
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
    record, room = dataset.sample[dataset.getind("sample", sample)], current_style().room
    if view_range is not None:
        check_view_range(view_range)
    shared = shared_boxes(dataset, record, link, agents)
    reach = view_range or _reach(dataset, record, shared)
    clouds = (
        {"without the link": None, "with the link": link}
        if "points" in shown and room != "column"
        else {}
    )
    if current_style().few:
        clouds.pop("without the link", None)
    wide = 1.0 if clouds else widening(None) ** 1.5  # the legend is below
    size = 5.0 * (1 + len(clouds)) + 0.4, 6.4
    fig = figure_or_new(
        fig, size, panels="several" if clouds else "one", page=0.6 if clouds else 1.28, column=1.28
    )
    first, *others = fig.subplots(1, 1 + len(clouds), squeeze=False)[0]
    first.set(xlim=(-wide * reach, wide * reach), ylim=(-reach, reach), aspect="equal")
    x_words, y_words = axis_words("ego")
    first.set(xlabel=x_words, ylabel=y_words, title=_error_words(shared))
    _draw_shared(shared, shown, first)
    write_beside(
        first, f"{short_name(record['agent'])} receives", (0.0, 0.0), AGENT_COLORS[record["agent"]]
    )
    for ax, (words, there) in zip(others, clouds.items(), strict=True):
        draw_bev(
            dataset,
            record,
            BevView(view_range=reach, agents=agents, link=there),
            shown - {"boxes", "ids"},
            ax,
        )
        ax.set(title=f"clouds {words}", anchor="C")
        if "boxes" in shown:
            truth = cooperative_boxes(dataset, record, agents=agents, frame="ego")
            draw_boxes_from_above(truth, ax, [OWN_COLOR] * len(truth), fill=0.0, linewidths=0.7)
    draw_legend(fig, [*map(_handle, shared), *_handles()], columns=4)
    set_scene_title(fig, dataset, record["token"], below=link_words(link))
    return settled(fig)


def _reach(dataset: Dataset, record: SampleRecord, shared: Sequence[SharedBoxes]) -> float:
    """Metres to each side of the ego up to the agents and the colliding pair, within bounds."""
    places = [
        transform(dataset, record, at_once(record, each.agent), "ego", "ego").translation[:2]
        for each in shared
    ]
    pair = [
        each.true.select(np.isin(each.true.actor_id, [*collider_ids(dataset, record)]))
        for each in shared
    ]
    far = np.concatenate([np.array(places), *(boxes.center[:, :2] for boxes in pair)])
    return float(np.clip(np.abs(far).max() + _AROUND, *_REACHES))


def shared_boxes(
    dataset: Dataset, sample: RowArgument, link: Link, agents: Agents = None
) -> list[SharedBoxes]:
    """Each partner's tracked boxes as they arrive; arguments and errors as in `render_link`."""
    record = dataset.get("sample", sample)
    partners = [
        agent for agent in cooperating_agents(dataset, sample, agents) if agent != record["agent"]
    ]
    if not partners:
        raise ChoiceError(
            f"agents: expected a partner of {record['agent']}, found none; a link needs two agents"
        )
    arriving = {
        message.agent for message in messages(dataset, sample, agents, link)
    }  # together they may not fit
    return [
        SharedBoxes(
            agent=agent,
            true=_tracked(cooperative_boxes(dataset, sample, agents=[agent], frame="ego")),
            received=_tracked(
                cooperative_boxes(
                    dataset,
                    sample,
                    agents=[agent],
                    frame="ego",
                    link=link if agent in arriving else replace(link, packet_loss=1.0),
                )
            ),
        )
        for agent in partners
    ]


def _tracked(boxes: Boxes) -> Boxes:
    return boxes.select(boxes.actor_id != UNTRACKED_ID)


def _draw_shared(shared: Sequence[SharedBoxes], shown: frozenset[Layer], ax: Axes) -> None:
    """Render partners' boxes, and how far they are from their places."""
    ax.plot(0, 0, **_RECEIVER)
    keep_free(ax, [[(0.0, 0.0)]], margin=(-5, -5, 5, 5))
    true = concatenate([each.true for each in shared], "ego")
    true = true.select(np.unique(true.actor_id, return_index=True)[1])
    hues = [TRUE_PLACE_COLOR] * len(true)
    if "boxes" in shown:
        draw_boxes_from_above(true, ax, hues, fill=0, linestyle=_DASHED, linewidths=1)
    for each in shared:
        colors = [AGENT_COLORS[each.agent]] * len(each.received)
        if "boxes" in shown:
            draw_boxes_from_above(each.received, ax, colors, fill=0.25, linewidths=1)
        start, end = each.shifts
        if len(start):
            how: dict[str, Any] = {
                "angles": "xy",
                "scale_units": "xy",
                "scale": 1,
                "width": 0.004,
                "zorder": 4,
            }
            ax.quiver(*start.T, *(end - start).T, color=OWN_COLOR, **how)
    if "ids" in shown:
        draw_ids_from_above(true, ax, hues)
    if "grid" in shown:
        with_light_grid(ax, "both")


def _handle(shared: SharedBoxes) -> Artist:
    """A partner's hue, and how far its boxes are from their places on average."""
    from matplotlib.patches import Patch

    color = AGENT_COLORS[shared.agent]
    return Patch(facecolor=(color, 0.25), edgecolor=color, label=_shift_words(shared))


def _handles() -> list[Artist]:
    """What the other marks of the first panel mean."""
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
    start, end = shared.shifts
    if not len(start):
        return f"{name}: no box in common"
    apart = np.linalg.norm(end - start, axis=1)
    return f"{name}: {apart.mean():.2f} m"


def _error_words(shared: Sequence[SharedBoxes]) -> str:
    """The title of all partners' boxes."""
    apart = [np.linalg.norm(np.subtract(*each.shifts), axis=1) for each in shared]
    return f"boxes, off by at most {np.concatenate(apart).max(initial=0):.2f} m"
