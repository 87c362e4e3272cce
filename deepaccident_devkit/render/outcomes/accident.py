"""Foreseen accidents against the true one: where, when, and how far off."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.evaluation.metrics.accident import AccidentResult, BoxTruth, ComparedAccidents
from deepaccident_devkit.evaluation.metrics.accident.scoring import AccidentsWithin
from deepaccident_devkit.evaluation.metrics.alarms.raised import position_difference
from deepaccident_devkit.evaluation.metrics.predictions import Accident
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.render.axes import axes_or_new, titled_from_above
from deepaccident_devkit.render.boxes import draw_boxes_from_above, draw_ids_from_above, write_beside
from deepaccident_devkit.render.chips import keep_free
from deepaccident_devkit.render.colors import COLLIDER_COLOR, OUTCOME_COLORS
from deepaccident_devkit.render.layers import Layer, layers_of
from deepaccident_devkit.render.legends import INSIDE, draw_legend
from deepaccident_devkit.render.styles import in_own_settings
from deepaccident_devkit.render.trails import draw_trail

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ACCIDENT_LAYERS: Final[tuple[Layer, ...]] = ("boxes", "trajectories", "ids", "grid")
_SHOWN: Final[tuple[Layer, ...]] = ("boxes", "trajectories", "grid")
_LEAST: Final = 20.0
_MOST: Final = 60.0
"""Metres around an accident that are shown, at least and at most."""
_MARK: Final = (-7.0, -7.0, 7.0, 7.0)
"""Points around circles, crosses and the lines between them that no words cover: left, low, right and high."""
FORESEEN_COLOR: Final = "black"
"""Whether it is right is what the picture shows."""


@in_own_settings
def draw_accident_outcome(
    compared: ComparedAccidents,
    truth: BoxTruth | None = None,
    *,
    layers: Iterable[Layer] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Render the true places of the two that collide and the foreseen places, with the metres between them.

    Args:
        compared: what a protocol compares, from `compared_accidents`.
        truth: the actors around, as they are now, and where the pair goes; None renders only the accidents.
        layers: `boxes` (the actors now), `trajectories` (of the pair) and `grid` are the default; also `ids`.
        ax: axes to render on; new ones if None.

    Returns:
        The axes, in metres of the present ego frame.

    Raises:
        ChoiceError: no such layer.
    """
    shown = layers_of(layers, _SHOWN, ACCIDENT_LAYERS)
    ax = axes_or_new(ax, (6, 6.4))
    if truth is not None:
        _draw_actors(truth, compared, shown, ax)
    if compared.true is not None:
        x, y = compared.true.positions.T
        (line,) = ax.plot(x, y, "o-", markersize=12, fillstyle="none", color=COLLIDER_COLOR, linewidth=1.6, zorder=5)
        line.set_label("to come")
        _keep_line_free(*compared.true.positions, ax=ax)
    for alarm in compared.predicted:
        (line,) = ax.plot(*alarm.positions.T, "x--", color=FORESEEN_COLOR, markersize=9, markeredgewidth=2, zorder=6)
        line.set_label("foreseen" if alarm is compared.predicted[0] else "")
        _keep_line_free(*alarm.positions, ax=ax)
        place = alarm.positions.mean(axis=0)
        write_beside(ax, alarm_words(alarm), (float(place[0]), float(place[1])), FORESEEN_COLOR)
        if compared.true is not None:
            _draw_differences(alarm, compared.true, ax)
    _look_at(compared, ax)
    handles, _ = ax.get_legend_handles_labels()
    draw_legend(ax, handles, columns=1, **INSIDE)
    return titled_from_above(ax, difference_words(compared), grid="grid" in shown)


def alarm_words(alarm: Accident) -> str:
    """When an accident is foreseen, and how sure that is: `in 1.5 s, score 0.9`."""
    return f"in {alarm.time:.1f} s, score {alarm.score:.2g}"


def difference_words(compared: ComparedAccidents) -> str:
    """The true accident, and on another line the errors of the surest alarm: of both places in sum, of the time."""
    true, comes = compared.true, coming_words(compared)
    if not compared.predicted:
        return f"{comes}, none is foreseen"
    alarm = compared.predicted[0]
    if true is None:
        return f"{comes}, one is foreseen in {alarm.time:.1f} s"
    off = position_difference(alarm.positions, true.positions)
    return f"{comes};\nforeseen {off:.1f} m off in sum, {alarm.time - true.time:+.1f} s"


def coming_words(compared: ComparedAccidents) -> str:
    """Whether an accident comes, and when."""
    if compared.unplaced is not None:
        return f"an accident comes in {compared.unplaced:.1f} s that no label shows both actors of"
    return "no accident comes" if compared.true is None else f"an accident comes in {compared.true.time:.1f} s"


def verdict_words(result: AccidentResult) -> str:
    """What one sample counts as, by the allowed distance: `5 m: FP + FN, 10 m: TP`; `TN` if nothing is counted."""
    return ", ".join(f"{distance:g} m: {count_words(within)}" for distance, within in result.within.items())


def count_words(within: AccidentsWithin) -> str:
    """What one sample counts as within a distance, such as `FP + FN`; `TN` if nothing is counted."""
    counts = {"TP": within.tp, "FP": within.fp, "FN": within.fn}
    said = [f"{count} {name}" if count > 1 else name for name, count in counts.items() if count]
    return " + ".join(said) or "TN"


def _draw_actors(truth: BoxTruth, compared: ComparedAccidents, shown: frozenset[Layer], ax: Axes) -> None:
    present = truth.footprint[0]
    here = np.isfinite(present[:, 0])
    x, y, length, width, yaw = present[here].T
    boxes = Boxes.from_arrays(
        np.column_stack([x, y, np.zeros(len(x))]),
        np.column_stack([length, width, np.ones(len(x))]),
        yaw,
        frame="ego",
        actor_id=truth.actor_id[here],
    )
    ids = (None if compared.true is None or truth.accident is None else truth.accident.ids) or ()
    pair = np.isin(boxes.actor_id, ids).tolist()
    colors = [COLLIDER_COLOR if collides else OUTCOME_COLORS["missed"] for collides in pair]
    if "boxes" in shown:
        draw_boxes_from_above(boxes, ax, colors, fill=0.15, linewidths=0.8)
    if "ids" in shown:
        draw_ids_from_above(boxes, ax, ["black"] * len(boxes))
    if "trajectories" in shown:
        for column in np.flatnonzero(np.isin(truth.actor_id, ids)).tolist():
            path = truth.footprint[:, column, :2]
            draw_trail(path[np.isfinite(path[:, 0])], ax, COLLIDER_COLOR, linewidths=2.0)


def _draw_differences(alarm: Accident, true: Accident, ax: Axes) -> None:
    """Dotted lines with metres from the two foreseen places to the two true ones, paired so that they are nearest."""
    for start, end in _pairs(alarm.positions, true.positions):
        ax.plot(*np.stack([start, end]).T, ":", color="black", linewidth=1.2, zorder=4)
        _keep_line_free(start, end, ax=ax)
        x, y = ((start + end) / 2).tolist()
        write_beside(ax, f"{np.linalg.norm(start - end):.1f} m", (x, y), "black")


def _keep_line_free(start: FloatArray, end: FloatArray, *, ax: Axes) -> None:
    """Let no words cover a line between two places, and the marks at its ends."""
    keep_free(ax, np.linspace(start, end, 9)[:, None], margin=_MARK)


def _pairs(places: FloatArray, others: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    apart = np.linalg.norm(places[:, None] - others, axis=-1)
    straight = apart[0, 0] + apart[1, 1] <= apart[0, 1] + apart[1, 0]
    return list(zip(places, others if straight else others[::-1], strict=True))


def _look_at(compared: ComparedAccidents, ax: Axes) -> None:
    accidents = [*([] if compared.true is None else [compared.true]), *compared.predicted]
    places = np.concatenate([each.positions for each in accidents]) if accidents else np.zeros((1, 2))
    middle = accidents[0].positions.mean(axis=0) if accidents else places[0]
    half = float(np.clip(np.abs(places - middle).max() + 10, _LEAST, _MOST))
    ax.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))
