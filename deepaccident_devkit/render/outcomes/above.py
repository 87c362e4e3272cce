"""A prediction on top of the truth, from above: foreseen accidents, detected boxes, and motion."""

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
    labels_at_present,
    num_recorded_frames,
)
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.motion import POST_PROCESSING, MotionLabels
from deepaccident_devkit.render.boxes import (
    draw_boxes_from_above,
    draw_ids_from_above,
    draw_trail,
    write_beside,
)
from deepaccident_devkit.render.captions import (
    INSIDE,
    draw_legend,
    draw_legend_of_fills,
    titled_from_above,
)
from deepaccident_devkit.render.chips import keep_line_free
from deepaccident_devkit.render.figures import (
    Layer,
    Layers,
    axes_or_new,
    layers_of,
    show_square,
    square_around,
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
from deepaccident_devkit.support.arrays import AnyArray, IntArray, ShortRepr

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

ACCIDENT_LAYERS: Final[Layers] = ("boxes", "trajectories", "ids", "grid")
# Minimum and maximum number of metres shown to each side of the centre.
_MIN_VIEW_RANGE_M = 15.0
_MAX_VIEW_RANGE_M = 60.0
# Metres shown around the positions of accidents and actors.
_VIEW_MARGIN_M = 8.0
# Margin in points around circles, crosses and the lines between them that words do not cover: left,
# below, right and above.
_MARK_MARGIN_PT = (-7.0, -7.0, 7.0, 7.0)
# The position shows whether a foreseen accident is right, so one colour is enough.
FORESEEN_COLOR: Final = "black"
DETECTION_LAYERS: Final[Layers] = ("boxes", "ids", "grid")
# Metres shown to each side of the agent.
VIEW_RANGE: Final = 50.0
# Line style of missed true boxes and instances.
DASHED: Final = (0, (2, 1))
_Side = Literal["true", "predicted"]
MOTION_LAYERS: Final[Layers] = ("labels", "trajectories", "ids", "grid")
# Codes of `MotionOutcome.outcomes`.
_RIGHT_CODE = 1
_WRONG_CODE = 2
_UNCOUNTED_CODE = 3
_OUTCOME_WORDS: dict[_Side, tuple[str, str]] = {
    "true": ("found", "missed"),
    "predicted": ("right", "false"),
}


def layers_without_ids(
    layers: Iterable[Layer] | None, possible: Sequence[Layer]
) -> frozenset[Layer]:
    """Return the layers to render, by default all except `ids`; raise ChoiceError if impossible."""
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

    Lines between them are labelled with their lengths in metres.

    Args:
        compared: Accidents that a protocol compares, from `compared_accidents`.
        truth: Surrounding actors in the current frame, and the pair's future paths; None renders
            only the accidents.
        layers: Any of `boxes` (the actors in the current frame), `trajectories` (the pair's paths
            to its boxes at the impact and, dashed, the foreseen paths of the actors that an alarm
            names), `grid` and `ids`; by default all except ids.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes, in metres, in the ego frame at t = 0.

    Raises:
        ChoiceError: No such layer.
    """
    shown_layers = layers_without_ids(layers, ACCIDENT_LAYERS)
    ax = axes_or_new(ax, (6, 6.4))
    handles = draw_accidents(compared, truth, shown_layers, ax)
    draw_legend(ax, handles, columns=1, **INSIDE)
    return ax


def draw_accidents(
    compared: ComparedAccidents, truth: BoxTruth | None, layers: frozenset[Layer], ax: Axes
) -> list[Artist]:
    """Render what `draw_accident_outcome` shows, and return the legend handles for it."""
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
        line.set_label("actual")
        keep_line_free(ax, compared.true.positions, margin=_MARK_MARGIN_PT)
    for alarm in compared.predicted:
        (line,) = ax.plot(
            *alarm.positions.T,
            "x--",
            color=FORESEEN_COLOR,
            markersize=9,
            markeredgewidth=2,
            zorder=6,
        )
        line.set_label("predicted" if alarm is compared.predicted[0] else "")
        if truth is not None and "trajectories" in layers:
            _draw_foreseen_paths(alarm, truth, ax)
        keep_line_free(ax, alarm.positions, margin=_MARK_MARGIN_PT)
        x, y = alarm.positions.mean(axis=0).tolist()
        write_beside(ax, alarm.words, (x, y), FORESEEN_COLOR)
        if compared.true is not None:
            _draw_differences(alarm, compared.true, ax)
    center, half = shown_square(compared, truth)
    show_square(ax, center, half)
    titled_from_above(ax, difference_words(compared), grid="grid" in layers)
    return ax.get_legend_handles_labels()[0]


def difference_words(compared: ComparedAccidents) -> str:
    """Describe the true accident and, on a second line, the errors of the first alarm.

    The errors are the sum of both position errors, and the time error. The first alarm is the most
    confident one.
    """
    true = compared.true
    words = coming_words(compared)
    has_accident = true is not None or compared.unplaced is not None
    if not compared.predicted:
        return f"missed: {words}" if has_accident else words
    alarm = compared.predicted[0]
    if true is None:
        return f"{words}, but predicted in {alarm.time:.1f} s"
    difference = position_difference(alarm.positions, true.positions)
    return f"{words};\n{error_words(difference, alarm.time - true.time)}"


def error_words(position_error: float, delay: float) -> str:
    """Describe an alarm's errors: `position error 3.2 m (both actors), 0.5 s late`."""
    timing = "on time"
    if round(delay, 1):
        timing = f"{abs(delay):.1f} s {'late' if delay > 0 else 'early'}"
    return f"position error {position_error:.1f} m (both actors), {timing}"


def coming_words(compared: ComparedAccidents) -> str:
    """State in words whether an accident follows, and when."""
    if compared.unplaced is not None:
        return f"collision in {compared.unplaced:.1f} s, but no label shows both actors"
    if compared.true is None:
        return "no collision within the horizon"
    return f"collision in {compared.true.time:.1f} s"


def verdict_words(result: AccidentResult) -> str:
    """Name a sample's outcomes with their allowed distances: `FP + FN within 5 m, TP within 10 m`.

    Equal outcomes are joined. The outcome is `TN` if nothing is counted.
    """
    distances: dict[str, list[str]] = {}
    for distance, within in result.within.items():
        distances.setdefault(count_words(within), []).append(f"{distance:g}")
    return ", ".join(f"{counts} within {'/'.join(at)} m" for counts, at in distances.items())


def count_words(within: AccidentsWithin) -> str:
    """Name a sample's outcome at one allowed distance: `FP + FN`; `TN` if nothing is counted."""
    words = []
    for name, count in (("TP", within.tp), ("FP", within.fp), ("FN", within.fn)):
        if count > 1:
            words.append(f"{count} {name}")
        elif count:
            words.append(name)
    return " + ".join(words) or "TN"


def _draw_actors(
    truth: BoxTruth, compared: ComparedAccidents, layers: frozenset[Layer], ax: Axes
) -> None:
    """Draw the actors in the current frame, and the pair's paths and boxes up to the impact."""
    boxes = _boxes_at(truth, 0)
    pair_ids = _pair_ids(compared, truth)
    colors = []
    for collides in np.isin(boxes.actor_id, pair_ids).tolist():
        colors.append(COLLIDER_COLOR if collides else OUTCOME_COLORS["missed"])
    if "boxes" in layers:
        draw_boxes_from_above(boxes, ax, colors, fill=0.15, linewidths=0.8)
    if "ids" in layers:
        draw_ids_from_above(boxes, ax, ["black"] * len(boxes))
    if "trajectories" in layers:
        for actor_column in np.flatnonzero(np.isin(truth.actor_id, pair_ids)).tolist():
            path = truth.footprint[:, actor_column, :2]
            is_annotated = np.isfinite(path[:, 0])
            draw_trail(path[is_annotated], ax, COLLIDER_COLOR, linewidths=2.0)
        if compared.true is not None:
            impact_frame = int(np.abs(truth.time - compared.true.time).argmin())
            at_impact = _boxes_at(truth, impact_frame)
            pair = at_impact.select(np.isin(at_impact.actor_id, pair_ids))
            draw_boxes_from_above(pair, ax, [COLLIDER_COLOR] * len(pair), fill=0)


def _pair_ids(compared: ComparedAccidents, truth: BoxTruth) -> Sequence[int]:
    """Return the ids of the actors that collide; empty if the protocol does not compare them."""
    if compared.true is None or truth.accident is None:
        return ()
    return truth.accident.ids or ()


def _boxes_at(truth: BoxTruth, frame: int) -> Boxes:
    """Return a frame's annotated boxes in the ego frame at t = 0, all 1 m high at z = 0."""
    footprint = truth.footprint[frame]
    is_annotated = np.isfinite(footprint[:, 0])
    x, y, length, width, yaw = footprint[is_annotated].T
    center = np.column_stack([x, y, np.zeros(len(x))])
    size = np.column_stack([length, width, np.ones(len(x))])
    actor_id = truth.actor_id[is_annotated]
    return Boxes.from_arrays(center, size, yaw, frame="ego", actor_id=actor_id)


def _draw_foreseen_paths(alarm: Accident, truth: BoxTruth, ax: Axes) -> None:
    """Draw dashed lines from the actors that an alarm names to their foreseen positions."""
    present_positions = dict(zip(truth.actor_id.tolist(), truth.footprint[0, :, :2], strict=True))
    for actor, foreseen in zip(alarm.ids or (), alarm.positions, strict=False):
        if actor in present_positions:
            x, y = np.column_stack([present_positions[actor], foreseen])
            ax.plot(
                x,
                y,
                color=FORESEEN_COLOR,
                linestyle=DASHED,
                linewidth=1.0,
                zorder=4,
            )


def _draw_differences(alarm: Accident, true: Accident, ax: Axes) -> None:
    """Draw dotted lines, labelled with their lengths, from the foreseen positions to the true ones.

    Of the two possible pairings, the one with the smaller sum of distances is drawn.
    """
    true_positions = true.positions
    distances = np.linalg.norm(alarm.positions[:, None] - true_positions, axis=-1)
    straight_sum = distances[0, 0] + distances[1, 1]
    crossed_sum = distances[0, 1] + distances[1, 0]
    if crossed_sum < straight_sum:
        true_positions = true_positions[::-1]
    for line in np.stack([alarm.positions, true_positions], axis=1):
        ax.plot(*line.T, ":", color="black", linewidth=1.2, zorder=4)
        keep_line_free(ax, line, margin=_MARK_MARGIN_PT)
        x, y = (line.sum(axis=0) / 2).tolist()
        length = np.linalg.norm(line[0] - line[1])
        write_beside(ax, f"{length:.1f} m", (x, y), "black")


def shown_square(
    compared: ComparedAccidents, truth: BoxTruth | None
) -> tuple[tuple[float, float], float]:
    """Return the centre of the square to show, and how many metres it extends to each side.

    It contains the accidents, the agent and, if known, the pair's positions in the current frame.
    """
    positions = [np.zeros((1, 2))]
    if compared.true is not None:
        positions.append(compared.true.positions)
    positions += [alarm.positions for alarm in compared.predicted]
    if truth is not None:
        is_pair = np.isin(truth.actor_id, _pair_ids(compared, truth))
        is_annotated = np.isfinite(truth.footprint[0, :, 0])
        positions.append(truth.footprint[0, is_pair & is_annotated, :2])
    center, half = square_around(np.concatenate(positions), _VIEW_MARGIN_M)
    x, y = center.tolist()
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
        truth: True boxes in the same frame, as returned by `detection_truth`.
        protocol: Protocol (or its name) whose matching rules are used.
        threshold: One of the protocol's matching thresholds; None for the one at which it computes
            errors or, if it computes none, the middle one.
        layers: Any of `boxes`, `grid` (these are the default) and `ids` (of the true boxes).
        ax: Axes to render on; new ones if None.

    Returns:
        The axes, in metres in the protocol's frame; the title states the counts. Boxes that do not
        count, such as boxes outside the protocol's area, are not rendered.

    Raises:
        ChoiceError: No such protocol, threshold or layer.
    """
    shown_layers = layers_without_ids(layers, DETECTION_LAYERS)
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
    matched = truth.select(matches.truth)
    missed = truth.select(matches.missed)
    draw_boxes_from_above(matched, ax, ["black"] * len(matched), fill=0, linewidths=0.7)
    colors = [OUTCOME_COLORS["missed"]] * len(missed)
    draw_boxes_from_above(missed, ax, colors, fill=0.3, linestyle=DASHED, linewidths=1.6)


def detection_words(
    prediction: DetectedBoxes,
    truth: Boxes,
    matches: DetectionMatches,
    protocol: str | DetectionProtocol,
) -> str:
    """State the threshold, the box counts, and the mean error of the matched boxes in words."""
    limit = f"overlap {matches.threshold:g}"
    if detection_protocol(protocol).measure.startswith("distance"):
        limit = f"{matches.threshold:g} m"
    tp = len(matches.detection)
    counts = f"at {limit}: {tp} TP, {len(matches.false)} FP, {len(matches.missed)} FN"
    if not tp:
        return counts
    detected_centers = prediction.boxes.center[matches.detection, :2]
    true_centers = truth.center[matches.truth, :2]
    distances = np.linalg.norm(detected_centers - true_centers, axis=1)
    return f"{counts};\ncentres off by {distances.mean():.2f} m on average"


def _draw_selection(boxes: Boxes, rows: IntArray, color: str, ax: Axes) -> None:
    selection = boxes.select(rows)
    draw_boxes_from_above(selection, ax, [color] * len(selection))


def _draw_offsets(detected: Boxes, truth: Boxes, matches: DetectionMatches, ax: Axes) -> None:
    """Draw a line from the centre of each matched detection to the centre of its true box."""
    from matplotlib.collections import LineCollection

    starts = detected.center[matches.detection, :2]
    ends = truth.center[matches.truth, :2]
    lines = list(np.stack([starts, ends], axis=1))
    offsets = LineCollection(lines, colors="black", linewidths=1.0, zorder=4)
    ax.add_collection(offsets)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionOutcome(ShortRepr):
    """The true and the predicted instances of the evaluated frames, and their matches.

    Attributes:
        true: Instances of the labels.
        predicted: Instances of the last prediction.
        matches: True positives, (N, 3) int64: frame from 0, predicted id and true id.
        extent: Side of the square around the ego within which instances are matched, metres; the
            protocol's largest range.
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

        An outcome is 1 for instances that are matched in that frame, 2 for unmatched ones, 3 for
        ids beyond the range, and 0 for all other cells.
        """
        maps = self.maps(side)
        match_frames, predicted_ids, true_ids = self.matches.T
        ids = true_ids if side == "true" else predicted_ids
        outcomes = np.zeros(maps.instance.shape, dtype=np.int64)
        within = cells_within(maps.grid, self.extent)
        for frame, instance in enumerate(maps.instance):
            is_occupied = instance > 0
            is_counted = is_occupied & np.isin(instance, instance[within])
            is_matched = np.isin(instance, ids[match_frames == frame])
            outcomes[frame][is_occupied] = _UNCOUNTED_CODE
            outcomes[frame][is_counted] = _WRONG_CODE
            outcomes[frame][is_matched] = _RIGHT_CODE
        return outcomes

    def judged(self, side: _Side, frame: int) -> dict[str, IntArray]:
        """Return the ids of a frame's instances by outcome, leaving out ids beyond the range.

        Matched instances are `right`; unmatched predicted ones are `false`, and unmatched true ones
        `missed`.
        """
        instance = self.maps(side).instance[frame]
        codes = self.outcomes(side)[frame]
        if side == "true":
            wrong_kind = "missed"
        else:
            wrong_kind = "false"
        ids = {}
        for kind, code in (("right", _RIGHT_CODE), (wrong_kind, _WRONG_CODE)):
            kind_ids = np.unique(instance[codes == code])
            ids[kind] = kind_ids.astype(np.int64)
        return ids


def motion_outcome(prediction: MotionOutput, label: MotionLabels) -> MotionOutcome:
    """Match the instances of the last prediction as VPQ does, within its largest range.

    Raises:
        EvaluationError: The current frame is not recorded.
    """
    frames = num_recorded_frames(label)
    true = maps_of_labels(labels_at_present(label))
    predicted = maps_of_output(
        prediction, step=true.step, post_processing=POST_PROCESSING["motion"]
    )
    true = _first_frames(true, frames)
    predicted = _first_frames(predicted, frames)
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

    Later frames are paler. The layers are `labels` (the cells), `trajectories`, `grid` and `ids`;
    by default all except ids. The axes are in metres, in the ego frame at t = 0; their title counts
    instances over all frames.
    """
    shown_layers = layers_without_ids(layers, MOTION_LAYERS)
    ax = axes_or_new(ax, (6, 6.4))
    maps = outcome.maps(side)
    right, wrong = _OUTCOME_WORDS[side]
    wrong_color = OUTCOME_COLORS["missed" if side == "true" else "false"]
    colors = {right: OUTCOME_COLORS["right"], wrong: wrong_color}
    colored_maps = _recolor(maps, outcome.outcomes(side), [*colors.values()])
    draw_trail_of(colored_maps, shown_layers & {"labels"}, ax)
    black_maps = _recolor(maps, maps.instance, [])
    draw_trail_of(black_maps, shown_layers - {"labels", "grid"}, ax)
    half = outcome.extent / 2
    x = [-half, half, half, -half, -half]
    y = [-half, -half, half, half, -half]
    ax.plot(x, y, ":", color="black", linewidth=0.8)
    draw_legend_of_fills(ax, colors)
    within = cells_within(maps.grid, outcome.extent)
    total = 0
    for instance in maps.instance:
        counted = instance[within]
        total += np.unique(counted[counted > 0]).size
    matched = len(outcome.matches)
    title = f"{side} instances: {matched} {right}, {total - matched} {wrong}"
    return titled_from_above(ax, title, grid="grid" in shown_layers)


def _first_frames(maps: MotionMaps, count: int) -> MotionMaps:
    valid = maps.valid[:count]
    instance = maps.instance[:count]
    return replace(maps, valid=valid, instance=instance)


def _recolor(maps: MotionMaps, instance: AnyArray, colors: list[str]) -> MotionMaps:
    """Replace the ids in the cells of maps, with one colour for each new id.

    Without colours, paths are black.
    """
    from matplotlib.colors import to_rgb

    palette = ["white", *colors, BEYOND_COLOR]
    if not colors:
        max_id = int(instance.max(initial=0))
        palette = ["white", *["black"] * max_id]
    rgb = np.array([to_rgb(color) for color in palette])
    return replace(maps, instance=instance, colors=rgb, own=-1)
