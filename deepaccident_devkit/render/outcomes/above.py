"""A prediction over the truth from above: foreseen accidents, detected boxes, and motion."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from deepaccident_devkit.evaluation.accident import AccidentResult, BoxTruth, ComparedAccidents
from deepaccident_devkit.evaluation.accident.scoring import AccidentsWithin
from deepaccident_devkit.evaluation.alarms import position_difference
from deepaccident_devkit.evaluation.detection import (
    DetectedBoxes,
    DetectionMatches,
    DetectionProtocol,
    detection_matches,
    detection_protocol,
)
from deepaccident_devkit.evaluation.instances import vpq_matches
from deepaccident_devkit.evaluation.motion import RANGES
from deepaccident_devkit.evaluation.predictions import (
    Accident,
    MotionOutput,
    cells_within,
    frames_there,
    labels_at_present,
)
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.motion import POST_PROCESSING, MotionLabels
from deepaccident_devkit.render.boxes import (
    draw_boxes_from_above,
    draw_ids_from_above,
    draw_trail,
    write_beside,
)
from deepaccident_devkit.render.captions import INSIDE, draw_legend, draw_legend_of_fills
from deepaccident_devkit.render.chips import keep_free
from deepaccident_devkit.render.figures import Layer, axes_or_new, layers_of, titled_from_above
from deepaccident_devkit.render.motion_maps import (
    MotionMaps,
    draw_trail_of,
    maps_of_labels,
    maps_of_output,
)
from deepaccident_devkit.render.styles import (
    BEYOND_COLOR,
    COLLIDER_COLOR,
    OUTCOME_COLORS,
    in_own_settings,
)
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, IntArray, ShortRepr

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

ACCIDENT_LAYERS: Final[tuple[Layer, ...]] = ("boxes", "trajectories", "ids", "grid")
_LEAST: Final = 15.0
# Metres to each side that are shown, at least and at most.
_MOST: Final = 60.0
# Metres that are shown around the places of accidents and the actors.
_AROUND: Final = 8.0
# Points around circles, crosses and the lines between them that no words cover: left, low, right and high.
_MARK: Final = (-7.0, -7.0, 7.0, 7.0)
# Whether it is right is what the picture shows.
FORESEEN_COLOR: Final = "black"
DETECTION_LAYERS: Final[tuple[Layer, ...]] = ("boxes", "ids", "grid")
# Metres around the agent that are shown.
VIEW_RANGE: Final = 50.0
# The lines around true boxes and instances that are missed.
DASHED: Final = (0, (2, 1))
_Side = Literal["true", "predicted"]
MOTION_LAYERS: Final[tuple[Layer, ...]] = ("labels", "trajectories", "ids", "grid")
_RIGHT, _WRONG, _UNCOUNTED = 1, 2, 3
_WORDS: Final[dict[_Side, tuple[str, str]]] = {
    "true": ("found", "missed"),
    "predicted": ("right", "false"),
}


def layers_but_ids(given: Iterable[Layer] | None, possible: Sequence[Layer]) -> frozenset[Layer]:
    """The layers to render, by default all of the possible ones but `ids`. Raises ChoiceError."""
    return layers_of(given, [layer for layer in possible if layer != "ids"], possible)


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
        layers: `boxes` (the actors now), `trajectories` (the pair's ways to its boxes at the impact, and dashed where
            the model has the actors go that it names) and `grid` are the default; also `ids`.
        ax: axes to render on; new ones if None.

    Returns:
        The axes, in metres of the present ego frame.

    Raises:
        ChoiceError: no such layer.
    """
    shown = layers_but_ids(layers, ACCIDENT_LAYERS)
    ax = axes_or_new(ax, (6, 6.4))
    draw_legend(ax, draw_accidents(compared, truth, shown, ax), columns=1, **INSIDE)
    return ax


def draw_accidents(
    compared: ComparedAccidents, truth: BoxTruth | None, shown: frozenset[Layer], ax: Axes
) -> list[Artist]:
    """Render all of `draw_accident_outcome` but the legend; returns what that explains."""
    if truth is not None:
        _draw_actors(truth, compared, shown, ax)
    if compared.true is not None:
        x, y = compared.true.positions.T
        (line,) = ax.plot(
            x,
            y,
            "o-",
            markersize=12,
            fillstyle="none",
            color=COLLIDER_COLOR,
            linewidth=1.6,
            zorder=5,
        )
        line.set_label("to come")
        _keep_line_free(*compared.true.positions, ax=ax)
    for alarm in compared.predicted:
        (line,) = ax.plot(
            *alarm.positions.T,
            "x--",
            color=FORESEEN_COLOR,
            markersize=9,
            markeredgewidth=2,
            zorder=6,
        )
        line.set_label("foreseen" if alarm is compared.predicted[0] else "")
        if truth is not None and "trajectories" in shown:
            _draw_foreseen_ways(alarm, truth, ax)
        _keep_line_free(*alarm.positions, ax=ax)
        place = alarm.positions.mean(axis=0)
        write_beside(ax, alarm_words(alarm), (float(place[0]), float(place[1])), FORESEEN_COLOR)
        if compared.true is not None:
            _draw_differences(alarm, compared.true, ax)
    (x, y), half = shown_square(compared, truth)
    ax.set(xlim=(x - half, x + half), ylim=(y - half, y + half))
    titled_from_above(ax, difference_words(compared), grid="grid" in shown)
    return ax.get_legend_handles_labels()[0]


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
    return (
        "no accident comes"
        if compared.true is None
        else f"an accident comes in {compared.true.time:.1f} s"
    )


def verdict_words(result: AccidentResult) -> str:
    """What one sample counts as, by the allowed distance: `5 m: FP + FN, 10 m: TP`; `TN` if nothing is counted."""
    return ", ".join(
        f"{distance:g} m: {count_words(within)}" for distance, within in result.within.items()
    )


def count_words(within: AccidentsWithin) -> str:
    """What one sample counts as within a distance, such as `FP + FN`; `TN` if nothing is counted."""
    counts = {"TP": within.tp, "FP": within.fp, "FN": within.fn}
    said = [f"{count} {name}" if count > 1 else name for name, count in counts.items() if count]
    return " + ".join(said) or "TN"


def _draw_actors(
    truth: BoxTruth, compared: ComparedAccidents, shown: frozenset[Layer], ax: Axes
) -> None:
    boxes = _boxes_at(truth, 0)
    ids = _pair_ids(compared, truth)
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
        if compared.true is not None:
            at_impact = _boxes_at(truth, int(np.abs(truth.time - compared.true.time).argmin()))
            pair = at_impact.select(np.isin(at_impact.actor_id, ids))
            draw_boxes_from_above(pair, ax, [COLLIDER_COLOR] * len(pair), fill=0)


def _pair_ids(compared: ComparedAccidents, truth: BoxTruth) -> Sequence[int]:
    """The actors that collide, if a protocol compares their accident."""
    return (None if compared.true is None or truth.accident is None else truth.accident.ids) or ()


def _boxes_at(truth: BoxTruth, frame: int) -> Boxes:
    """The boxes of a frame, of those that somebody annotated then; flat, in the present ego frame."""
    footprint = truth.footprint[frame]
    there = np.isfinite(footprint[:, 0])
    x, y, length, width, yaw = footprint[there].T
    return Boxes.from_arrays(
        np.column_stack([x, y, np.zeros(len(x))]),
        np.column_stack([length, width, np.ones(len(x))]),
        yaw,
        frame="ego",
        actor_id=truth.actor_id[there],
    )


def _draw_foreseen_ways(alarm: Accident, truth: BoxTruth, ax: Axes) -> None:
    """Dashed lines from where the actors that an alarm names are now to where it has them collide."""
    now = dict(zip(truth.actor_id.tolist(), truth.footprint[0, :, :2], strict=True))
    for actor, place in zip(alarm.ids or (), alarm.positions, strict=False):
        if actor in now:
            ax.plot(
                *np.stack([now[actor], place]).T,
                color=FORESEEN_COLOR,
                linestyle=DASHED,
                linewidth=1.0,
                zorder=4,
            )


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


def shown_square(
    compared: ComparedAccidents, truth: BoxTruth | None
) -> tuple[tuple[float, float], float]:
    """The middle of what is shown, and metres to each side: of the accidents, the agent and, if known, the pair now."""
    accidents = [*([] if compared.true is None else [compared.true]), *compared.predicted]
    places = np.concatenate([np.zeros((1, 2)), *(each.positions for each in accidents)])
    if truth is not None:
        present = truth.footprint[0, np.isin(truth.actor_id, _pair_ids(compared, truth)), :2]
        places = np.concatenate([places, present[np.isfinite(present[:, 0])]])
    low, high = places.min(axis=0), places.max(axis=0)
    x, y = ((low + high) / 2).tolist()
    return (x, y), float(np.clip((high - low).max() / 2 + _AROUND, _LEAST, _MOST))


@in_own_settings
def draw_detection_outcome(
    prediction: DetectedBoxes,
    truth: Boxes,
    protocol: str | DetectionProtocol = "released",
    *,
    threshold: float | None = None,
    layers: Iterable[Layer] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Render detections over true boxes: matched ones with a line to their true box, false ones, and missed boxes.

    Args:
        prediction: in the protocol's coordinate frame.
        truth: the true boxes in that frame, as `detection_truth` gives them.
        protocol: name, or a protocol: its matching decides.
        threshold: one of the protocol's; None for the threshold of its errors or, if it has none, the middle one.
        layers: `boxes` and `grid` are the default; also `ids`, those of the true boxes.
        ax: axes to render on; new ones if None.

    Returns:
        The axes, in metres of that frame; the title has the counts. Boxes that do not count, such as those outside the
        protocol's area, are not rendered.

    Raises:
        ChoiceError: no such protocol, threshold or layer.
    """
    shown = layers_but_ids(layers, DETECTION_LAYERS)
    matches = detection_matches(prediction, truth, protocol, threshold)
    ax = axes_or_new(ax, (6, 6.4))
    if "boxes" in shown:
        draw_true(truth, matches, ax)
        _draw(prediction.boxes, matches.detection, OUTCOME_COLORS["right"], ax)
        _draw(prediction.boxes, matches.false, OUTCOME_COLORS["false"], ax)
        _draw_offsets(prediction.boxes, truth, matches, ax)
    if "ids" in shown:
        true = truth.select(np.concatenate([matches.truth, matches.missed]))
        draw_ids_from_above(true, ax, ["black"] * len(true))
    ax.set(xlim=(-VIEW_RANGE, VIEW_RANGE), ylim=(-VIEW_RANGE, VIEW_RANGE))
    names = {"right": "detected", "false": "false", "missed": "missed"}
    draw_legend_of_fills(ax, {words: OUTCOME_COLORS[kind] for kind, words in names.items()})
    return titled_from_above(
        ax, detection_words(prediction, truth, matches, protocol), grid="grid" in shown
    )


def draw_true(truth: Boxes, matches: DetectionMatches, ax: Axes) -> None:
    """Render the true boxes that count; missed ones are dashed."""
    found, missed = truth.select(matches.truth), truth.select(matches.missed)
    draw_boxes_from_above(found, ax, ["black"] * len(found), fill=0, linewidths=0.7)
    colors = [OUTCOME_COLORS["missed"]] * len(missed)
    draw_boxes_from_above(missed, ax, colors, fill=0.3, linestyle=DASHED, linewidths=1.6)


def detection_words(
    prediction: DetectedBoxes,
    truth: Boxes,
    matches: DetectionMatches,
    protocol: str | DetectionProtocol,
) -> str:
    """The threshold, how many boxes are right, false and missed, and how far off the right ones are."""
    metres = detection_protocol(protocol).measure.startswith("distance")
    limit = f"{matches.threshold:g} m" if metres else f"overlap {matches.threshold:g}"
    counts = f"at {limit}: {len(matches.detection)} TP, {len(matches.false)} FP, {len(matches.missed)} FN"
    if not len(matches.detection):
        return counts
    apart = prediction.boxes.center[matches.detection, :2] - truth.center[matches.truth, :2]
    return f"{counts};\ncentres off by {np.linalg.norm(apart, axis=1).mean():.2f} m on average"


def _draw(boxes: Boxes, rows: IntArray, color: str, ax: Axes) -> None:
    chosen = boxes.select(rows)
    draw_boxes_from_above(chosen, ax, [color] * len(chosen))


def _draw_offsets(detected: Boxes, truth: Boxes, matches: DetectionMatches, ax: Axes) -> None:
    from matplotlib.collections import LineCollection

    ends = detected.center[matches.detection, :2], truth.center[matches.truth, :2]
    ax.add_collection(
        LineCollection(list(np.stack(ends, axis=1)), colors="black", linewidths=1.0, zorder=4)
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionOutcome(ShortRepr):
    """The true and the predicted instances of the evaluated frames, and which of them match.

    Attributes:
        true: the labels' instances.
        predicted: the last prediction's.
        matches: (N, 3) int64: frame from 0, predicted id and true id of the true positives.
        extent: metres: side of the square around the ego in which instances are matched, the protocol's widest.
    """

    true: MotionMaps
    predicted: MotionMaps
    matches: IntArray
    extent: float

    def outcomes(self, side: _Side) -> AnyArray:
        """(T, H, W) 1 for instances matched in that frame, 2 for unmatched ones, 3 beyond the range, 0 elsewhere."""
        maps = self.true if side == "true" else self.predicted
        result = np.zeros(maps.instance.shape, dtype=np.int64)
        within = cells_within(maps.grid, self.extent)
        for frame, instance in enumerate(maps.instance):
            found = self.matches[self.matches[:, 0] == frame, 2 if side == "true" else 1]
            result[frame][instance > 0] = _UNCOUNTED
            result[frame][(instance > 0) & np.isin(instance, instance[within])] = _WRONG
            result[frame][np.isin(instance, found)] = _RIGHT
        return result

    def judged(self, side: _Side, frame: int) -> dict[str, IntArray]:
        """A frame's ids by the kinds of `OUTCOME_COLORS`: `right`, and `false` or (true ones) `missed`; none beyond."""
        maps, kinds = (
            (self.true if side == "true" else self.predicted).instance[frame],
            self.outcomes(side)[frame],
        )
        named = {"right": _RIGHT, "missed" if side == "true" else "false": _WRONG}
        return {
            name: np.unique(maps[kinds == kind]).astype(np.int64) for name, kind in named.items()
        }


def motion_outcome(prediction: MotionOutput, label: MotionLabels) -> MotionOutcome:
    """Which instances of the last prediction match by VPQ in its widest range. Raises EvaluationError: no present."""
    frames = frames_there(label)
    true = _cut(maps_of_labels(labels_at_present(label)), frames)
    predicted = maps_of_output(
        prediction, step=true.step, post_processing=POST_PROCESSING["motion"]
    )
    predicted = _cut(predicted, frames)
    extent = max(RANGES.values())
    within = (slice(None), *cells_within(true.grid, extent))
    matches = vpq_matches(predicted.instance[within], true.instance[within])
    return MotionOutcome(true=true, predicted=predicted, matches=matches, extent=extent)


@in_own_settings
def draw_motion_side(
    outcome: MotionOutcome,
    side: _Side,
    *,
    layers: Iterable[Layer] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Render `true` instances as found or missed, or `predicted` ones as right or false; later frames are paler.

    The layers are `labels` (the cells), `trajectories` and `grid`, and if asked for `ids`. The axes are metres of the
    present ego frame; their title counts instances over all frames.
    """
    shown = layers_but_ids(layers, MOTION_LAYERS)
    ax = axes_or_new(ax, (6, 6.4))
    maps = outcome.true if side == "true" else outcome.predicted
    right, wrong = _WORDS[side]
    colors = {
        right: OUTCOME_COLORS["right"],
        wrong: OUTCOME_COLORS["missed" if side == "true" else "false"],
    }
    draw_trail_of(
        _recolored(maps, outcome.outcomes(side), [*colors.values()]), shown & {"labels"}, ax
    )
    draw_trail_of(_recolored(maps, maps.instance, []), shown - {"labels", "grid"}, ax)
    half = outcome.extent / 2
    ax.plot(
        np.array([-1, 1, 1, -1, -1]) * half,
        np.array([-1, -1, 1, 1, -1]) * half,
        ":",
        color="black",
        linewidth=0.8,
    )
    draw_legend_of_fills(ax, colors)
    counted = maps.instance[(slice(None), *cells_within(maps.grid, outcome.extent))]
    total = sum(np.unique(frame[frame > 0]).size for frame in counted)
    found = len(outcome.matches)
    return titled_from_above(
        ax, f"{side} instances: {found} {right}, {total - found} {wrong}", grid="grid" in shown
    )


def _cut(maps: MotionMaps, frames: int) -> MotionMaps:
    return replace(maps, valid=maps.valid[:frames], instance=maps.instance[:frames])


def _recolored(maps: MotionMaps, instance: AnyArray, colors: list[str]) -> MotionMaps:
    """The maps with other ids in their cells and a colour for each; without colours, for black paths."""
    from matplotlib.colors import to_rgb

    chosen = (
        ["white", *colors, BEYOND_COLOR]
        if colors
        else ["white", *["black"] * int(instance.max(initial=0))]
    )
    return replace(
        maps, instance=instance, colors=np.array([to_rgb(color) for color in chosen]), own=-1
    )
