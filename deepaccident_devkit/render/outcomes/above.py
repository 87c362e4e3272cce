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
from deepaccident_devkit.render.figures import (
    Layer,
    axes_or_new,
    layers_of,
    show_square,
    titled_from_above,
)
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
# Metres shown to each side of the centre.
_MIN_VIEW_RANGE_M: Final = 15.0
_MAX_VIEW_RANGE_M: Final = 60.0
# Metres shown around the positions of accidents and actors.
_VIEW_MARGIN_M: Final = 8.0
# Points around circles, crosses and the lines between them that no words cover: left, low, right
# and high.
_MARK_MARGIN_PT: Final = (-7.0, -7.0, 7.0, 7.0)
# The position shows whether a foreseen accident is right, so one colour is enough.
FORESEEN_COLOR: Final = "black"
DETECTION_LAYERS: Final[tuple[Layer, ...]] = ("boxes", "ids", "grid")
# Metres around the agent that are shown.
VIEW_RANGE: Final = 50.0
# Line style of missed true boxes and instances.
DASHED: Final = (0, (2, 1))
_Side = Literal["true", "predicted"]
MOTION_LAYERS: Final[tuple[Layer, ...]] = ("labels", "trajectories", "ids", "grid")
_RIGHT_CODE, _WRONG_CODE, _UNCOUNTED_CODE = 1, 2, 3
_OUTCOME_WORDS: Final[dict[_Side, tuple[str, str]]] = {
    "true": ("found", "missed"),
    "predicted": ("right", "false"),
}


def layers_but_ids(layers: Iterable[Layer] | None, possible: Sequence[Layer]) -> frozenset[Layer]:
    """Return the layers to render, by default all except `ids`. Raises ChoiceError."""
    default = [layer for layer in possible if layer != "ids"]
    return layers_of(layers, default, possible)


@in_own_settings
def draw_accident_outcome(
    compared: ComparedAccidents,
    truth: BoxTruth | None = None,
    *,
    layers: Iterable[Layer] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Render the true positions of a colliding pair and the foreseen ones.

    Lines between them have their lengths in metres.

    Args:
        compared: Accidents that a protocol compares, from `compared_accidents`.
        truth: Actors around, as they are now, and the future paths of the pair; None renders only
            the accidents.
        layers: `boxes` (the actors now), `trajectories` (the pair's paths to its boxes at the
            impact, and dashed the foreseen paths of the actors that an alarm names) and `grid` are
            the default; also `ids`.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes, in metres of the present ego frame.

    Raises:
        ChoiceError: No such layer.
    """
    shown_layers = layers_but_ids(layers, ACCIDENT_LAYERS)
    ax = axes_or_new(ax, (6, 6.4))
    handles = draw_accidents(compared, truth, shown_layers, ax)
    draw_legend(ax, handles, columns=1, **INSIDE)
    return ax


def draw_accidents(
    compared: ComparedAccidents, truth: BoxTruth | None, layers: frozenset[Layer], ax: Axes
) -> list[Artist]:
    """Render the picture of `draw_accident_outcome` without its legend, and return its handles."""
    if truth is not None:
        _draw_actors(truth, compared, layers, ax)
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
        if truth is not None and "trajectories" in layers:
            _draw_foreseen_paths(alarm, truth, ax)
        _keep_line_free(*alarm.positions, ax=ax)
        x, y = alarm.positions.mean(axis=0).tolist()
        write_beside(ax, alarm_words(alarm), (x, y), FORESEEN_COLOR)
        if compared.true is not None:
            _draw_differences(alarm, compared.true, ax)
    center, half = shown_square(compared, truth)
    show_square(ax, center, half)
    titled_from_above(ax, difference_words(compared), grid="grid" in layers)
    return ax.get_legend_handles_labels()[0]


def alarm_words(alarm: Accident) -> str:
    """Return the time and the score of a foreseen accident: `in 1.5 s, score 0.9`."""
    return f"in {alarm.time:.1f} s, score {alarm.score:.2g}"


def difference_words(compared: ComparedAccidents) -> str:
    """Return the true accident, and on another line the errors of the most confident alarm.

    These are the sum of the errors of both positions, and the error of the time.
    """
    true, words = compared.true, coming_words(compared)
    if not compared.predicted:
        return f"{words}, none is foreseen"
    alarm = compared.predicted[0]
    if true is None:
        return f"{words}, one is foreseen in {alarm.time:.1f} s"
    difference = position_difference(alarm.positions, true.positions)
    delay = alarm.time - true.time
    return f"{words};\nforeseen {difference:.1f} m off in sum, {delay:+.1f} s"


def coming_words(compared: ComparedAccidents) -> str:
    """Return whether an accident comes, and when."""
    if compared.unplaced is not None:
        return f"an accident comes in {compared.unplaced:.1f} s that no label shows both actors of"
    if compared.true is None:
        return "no accident comes"
    return f"an accident comes in {compared.true.time:.1f} s"


def verdict_words(result: AccidentResult) -> str:
    """Return the outcome of one sample by allowed distance: `5 m: FP + FN, 10 m: TP`.

    It is `TN` if nothing is counted.
    """
    return ", ".join(
        f"{distance:g} m: {count_words(within)}" for distance, within in result.within.items()
    )


def count_words(within: AccidentsWithin) -> str:
    """Return the outcome of one sample within a distance: `FP + FN`; `TN` if nothing is counted."""
    words = []
    for name, count in (("TP", within.tp), ("FP", within.fp), ("FN", within.fn)):
        if count:
            words.append(f"{count} {name}" if count > 1 else name)
    return " + ".join(words) or "TN"


def _draw_actors(
    truth: BoxTruth, compared: ComparedAccidents, layers: frozenset[Layer], ax: Axes
) -> None:
    boxes = _boxes_at(truth, 0)
    ids = _pair_ids(compared, truth)
    colors = []
    for collides in np.isin(boxes.actor_id, ids).tolist():
        colors.append(COLLIDER_COLOR if collides else OUTCOME_COLORS["missed"])
    if "boxes" in layers:
        draw_boxes_from_above(boxes, ax, colors, fill=0.15, linewidths=0.8)
    if "ids" in layers:
        draw_ids_from_above(boxes, ax, ["black"] * len(boxes))
    if "trajectories" in layers:
        for column in np.flatnonzero(np.isin(truth.actor_id, ids)).tolist():
            path = truth.footprint[:, column, :2]
            draw_trail(path[np.isfinite(path[:, 0])], ax, COLLIDER_COLOR, linewidths=2.0)
        if compared.true is not None:
            impact_frame = int(np.abs(truth.time - compared.true.time).argmin())
            at_impact = _boxes_at(truth, impact_frame)
            pair = at_impact.select(np.isin(at_impact.actor_id, ids))
            draw_boxes_from_above(pair, ax, [COLLIDER_COLOR] * len(pair), fill=0)


def _pair_ids(compared: ComparedAccidents, truth: BoxTruth) -> Sequence[int]:
    """Return the actors that collide, if a protocol compares their accident."""
    if compared.true is None or truth.accident is None:
        return ()
    return truth.accident.ids or ()


def _boxes_at(truth: BoxTruth, frame: int) -> Boxes:
    """Return the annotated boxes of a frame, flat, in the present ego frame."""
    footprint = truth.footprint[frame]
    present = np.isfinite(footprint[:, 0])
    x, y, length, width, yaw = footprint[present].T
    return Boxes.from_arrays(
        np.column_stack([x, y, np.zeros(len(x))]),
        np.column_stack([length, width, np.ones(len(x))]),
        yaw,
        frame="ego",
        actor_id=truth.actor_id[present],
    )


def _draw_foreseen_paths(alarm: Accident, truth: BoxTruth, ax: Axes) -> None:
    """Draw dashed lines from the actors that an alarm names to their foreseen positions."""
    present_positions = dict(zip(truth.actor_id.tolist(), truth.footprint[0, :, :2], strict=True))
    for actor, foreseen in zip(alarm.ids or (), alarm.positions, strict=False):
        if actor in present_positions:
            ax.plot(
                *np.stack([present_positions[actor], foreseen]).T,
                color=FORESEEN_COLOR,
                linestyle=DASHED,
                linewidth=1.0,
                zorder=4,
            )


def _draw_differences(alarm: Accident, true: Accident, ax: Axes) -> None:
    """Draw dotted lines with metres from the foreseen positions to the true ones.

    The pairing has the least sum of distances.
    """
    for start, end in _nearest_pairs(alarm.positions, true.positions):
        ax.plot(*np.stack([start, end]).T, ":", color="black", linewidth=1.2, zorder=4)
        _keep_line_free(start, end, ax=ax)
        x, y = ((start + end) / 2).tolist()
        write_beside(ax, f"{np.linalg.norm(start - end):.1f} m", (x, y), "black")


def _keep_line_free(start: FloatArray, end: FloatArray, *, ax: Axes) -> None:
    """Prevent words from covering a line and the marks at its ends."""
    keep_free(ax, np.linspace(start, end, 9)[:, None], margin=_MARK_MARGIN_PT)


def _nearest_pairs(
    positions: FloatArray, targets: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    distances = np.linalg.norm(positions[:, None] - targets, axis=-1)
    straight = distances[0, 0] + distances[1, 1]
    crossed = distances[0, 1] + distances[1, 0]
    if straight <= crossed:
        return list(zip(positions, targets, strict=True))
    return list(zip(positions, targets[::-1], strict=True))


def shown_square(
    compared: ComparedAccidents, truth: BoxTruth | None
) -> tuple[tuple[float, float], float]:
    """Return the centre of the shown area, and metres to each side of it.

    It shows the accidents, the agent and, if known, the present pair.
    """
    positions = [np.zeros((1, 2))]
    if compared.true is not None:
        positions.append(compared.true.positions)
    positions += [alarm.positions for alarm in compared.predicted]
    if truth is not None:
        pair = np.isin(truth.actor_id, _pair_ids(compared, truth))
        present = truth.footprint[0, pair, :2]
        positions.append(present[np.isfinite(present[:, 0])])
    points = np.concatenate(positions)
    low, high = points.min(axis=0), points.max(axis=0)
    x, y = ((low + high) / 2).tolist()
    half = (high - low).max() / 2 + _VIEW_MARGIN_M
    return (x, y), float(np.clip(half, _MIN_VIEW_RANGE_M, _MAX_VIEW_RANGE_M))


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
    """Render detections over true boxes: matched, false and missed ones.

    A line leads from a matched detection to its true box.

    Args:
        prediction: Detections in the protocol's coordinate frame.
        truth: True boxes in that frame, as `detection_truth` gives them.
        protocol: Name, or a protocol: its matching decides.
        threshold: Threshold of the protocol; None for the threshold of its errors or, if it has
            none, the middle one.
        layers: `boxes` and `grid` are the default; also `ids`, of the true boxes.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes, in metres of that frame; the title has the counts. Boxes that do not count, such
        as boxes outside the protocol's area, are not rendered.

    Raises:
        ChoiceError: No such protocol, threshold or layer.
    """
    shown_layers = layers_but_ids(layers, DETECTION_LAYERS)
    matches = detection_matches(prediction, truth, protocol, threshold)
    ax = axes_or_new(ax, (6, 6.4))
    if "boxes" in shown_layers:
        draw_true(truth, matches, ax)
        _draw_selection(prediction.boxes, matches.detection, OUTCOME_COLORS["right"], ax)
        _draw_selection(prediction.boxes, matches.false, OUTCOME_COLORS["false"], ax)
        _draw_offsets(prediction.boxes, truth, matches, ax)
    if "ids" in shown_layers:
        true = truth.select(np.concatenate([matches.truth, matches.missed]))
        draw_ids_from_above(true, ax, ["black"] * len(true))
    show_square(ax, (0, 0), VIEW_RANGE)
    colors = {
        "detected": OUTCOME_COLORS["right"],
        "false": OUTCOME_COLORS["false"],
        "missed": OUTCOME_COLORS["missed"],
    }
    draw_legend_of_fills(ax, colors)
    title = detection_words(prediction, truth, matches, protocol)
    return titled_from_above(ax, title, grid="grid" in shown_layers)


def draw_true(truth: Boxes, matches: DetectionMatches, ax: Axes) -> None:
    """Render the true boxes that count; missed ones are dashed."""
    matched, missed = truth.select(matches.truth), truth.select(matches.missed)
    draw_boxes_from_above(matched, ax, ["black"] * len(matched), fill=0, linewidths=0.7)
    colors = [OUTCOME_COLORS["missed"]] * len(missed)
    draw_boxes_from_above(missed, ax, colors, fill=0.3, linestyle=DASHED, linewidths=1.6)


def detection_words(
    prediction: DetectedBoxes,
    truth: Boxes,
    matches: DetectionMatches,
    protocol: str | DetectionProtocol,
) -> str:
    """Return the threshold, the counts of boxes, and the mean error of the right ones."""
    limit = f"overlap {matches.threshold:g}"
    if detection_protocol(protocol).measure.startswith("distance"):
        limit = f"{matches.threshold:g} m"
    tp, fp, fn = len(matches.detection), len(matches.false), len(matches.missed)
    counts = f"at {limit}: {tp} TP, {fp} FP, {fn} FN"
    if not tp:
        return counts
    offsets = prediction.boxes.center[matches.detection, :2] - truth.center[matches.truth, :2]
    distance = np.linalg.norm(offsets, axis=1).mean()
    return f"{counts};\ncentres off by {distance:.2f} m on average"


def _draw_selection(boxes: Boxes, rows: IntArray, color: str, ax: Axes) -> None:
    selection = boxes.select(rows)
    draw_boxes_from_above(selection, ax, [color] * len(selection))


def _draw_offsets(detected: Boxes, truth: Boxes, matches: DetectionMatches, ax: Axes) -> None:
    from matplotlib.collections import LineCollection

    ends = detected.center[matches.detection, :2], truth.center[matches.truth, :2]
    lines = list(np.stack(ends, axis=1))
    ax.add_collection(LineCollection(lines, colors="black", linewidths=1.0, zorder=4))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionOutcome(ShortRepr):
    """The true and the predicted instances of the evaluated frames, and which of them match.

    Attributes:
        true: Instances of the labels.
        predicted: Instances of the last prediction.
        matches: True positives, (N, 3) int64: frame from 0, predicted id and true id.
        extent: Side of the square around the ego in which instances are matched, metres; the
            protocol's widest.
    """

    true: MotionMaps
    predicted: MotionMaps
    matches: IntArray
    extent: float

    def maps(self, side: _Side) -> MotionMaps:
        """Return the true or the predicted instances."""
        if side == "true":
            return self.true
        return self.predicted

    def outcomes(self, side: _Side) -> AnyArray:
        """Return the outcome of each cell, shape (T, H, W).

        It is 1 for instances matched in that frame, 2 for unmatched ones, 3 beyond the range, and 0
        for other cells.
        """
        maps = self.maps(side)
        id_column = 2 if side == "true" else 1
        result = np.zeros(maps.instance.shape, dtype=np.int64)
        within = cells_within(maps.grid, self.extent)
        for frame, instance in enumerate(maps.instance):
            matched_ids = self.matches[self.matches[:, 0] == frame, id_column]
            occupied = instance > 0
            result[frame][occupied] = _UNCOUNTED_CODE
            result[frame][occupied & np.isin(instance, instance[within])] = _WRONG_CODE
            result[frame][np.isin(instance, matched_ids)] = _RIGHT_CODE
        return result

    def judged(self, side: _Side, frame: int) -> dict[str, IntArray]:
        """Return a frame's ids by the kinds of `OUTCOME_COLORS`, without any beyond the range.

        The kinds are `right`, and `false` or, for true instances, `missed`.
        """
        instance, codes = self.maps(side).instance[frame], self.outcomes(side)[frame]
        wrong_kind = "missed" if side == "true" else "false"
        ids = {}
        for kind, code in (("right", _RIGHT_CODE), (wrong_kind, _WRONG_CODE)):
            ids[kind] = np.unique(instance[codes == code]).astype(np.int64)
        return ids


def motion_outcome(prediction: MotionOutput, label: MotionLabels) -> MotionOutcome:
    """Return which instances of the last prediction match by VPQ in its widest range.

    Raises:
        EvaluationError: The present is not recorded.
    """
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
    """Render `true` instances as found or missed, or `predicted` ones as right or false.

    Later frames are paler. The layers are `labels` (the cells), `trajectories` and `grid`, and on
    request `ids`. The axes are metres of the present ego frame; their title counts instances over
    all frames.
    """
    shown_layers = layers_but_ids(layers, MOTION_LAYERS)
    ax = axes_or_new(ax, (6, 6.4))
    maps = outcome.maps(side)
    right, wrong = _OUTCOME_WORDS[side]
    wrong_color = OUTCOME_COLORS["missed" if side == "true" else "false"]
    colors = {right: OUTCOME_COLORS["right"], wrong: wrong_color}
    colored = _recolored(maps, outcome.outcomes(side), [*colors.values()])
    draw_trail_of(colored, shown_layers & {"labels"}, ax)
    black = _recolored(maps, maps.instance, [])
    draw_trail_of(black, shown_layers - {"labels", "grid"}, ax)
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
    matched = len(outcome.matches)
    title = f"{side} instances: {matched} {right}, {total - matched} {wrong}"
    return titled_from_above(ax, title, grid="grid" in shown_layers)


def _cut(maps: MotionMaps, frames: int) -> MotionMaps:
    return replace(maps, valid=maps.valid[:frames], instance=maps.instance[:frames])


def _recolored(maps: MotionMaps, instance: AnyArray, colors: list[str]) -> MotionMaps:
    """Return the maps with other ids in their cells and a colour for each.

    Without colours, paths are black.
    """
    from matplotlib.colors import to_rgb

    palette = ["white", *colors, BEYOND_COLOR]
    if not colors:
        palette = ["white", *["black"] * int(instance.max(initial=0))]
    rgb = np.array([to_rgb(color) for color in palette])
    return replace(maps, instance=instance, colors=rgb, own=-1)
