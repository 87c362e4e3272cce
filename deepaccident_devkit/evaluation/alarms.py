"""Alarms in predictions: explicit accidents, or accidents in motion maps, and their actors."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from deepaccident_devkit.evaluation.map_accidents import (
    AccidentReading,
    InstanceAccident,
    InstanceTracks,
    MapContact,
    match_tracks,
    predicted_accidents,
)
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput
from deepaccident_devkit.evaluation.truth import TIME_TOLERANCE_S, BoxTruth
from deepaccident_devkit.motion import LABEL_PROTOCOLS, MotionLabelConfig, MotionLabels
from deepaccident_devkit.support.arrays import FloatArray, IntArray
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.taxonomy import FRAME_PERIOD

# Seconds from one frame of the released labels to the next.
LABEL_STEP: Final = 0.5
# Metres: gate of the matches that decide which actors an alarm names.
MATCH_DISTANCE: Final = 4.0
# Alarms with a lower score do not count.
MIN_SCORE: Final = 0.0
# Ids of the named actors; None for an unknown one.
Pair = tuple[int | None, int | None]
# An alarm and the actors that it names.
NamedAlarm = tuple[Accident, Pair]
_RELEASED_LABELS: Final = MotionLabelConfig()


def named_alarms(
    prediction: MotionOutput | list[Accident],
    label: MotionLabels | None,
    truth: BoxTruth,
    reading: AccidentReading,
) -> list[NamedAlarm]:
    """Return the alarms of one sample with the actors that they name, the surest first.

    Of equally sure alarms the earliest comes first. K motion predictions are at most one alarm,
    scored by the share of them that have an accident. The mean sample (the last) gives place and
    time, or if it has no accident, the first that has one. An explicit accident without `ids`
    (actor ids) names the two actors with the box centres nearest to its positions at its time (at
    the last moment of the truth, if it is for later).

    Args:
        prediction: Motion in maps, or explicit accidents.
        label: Labels that define how far apart in time maps are and where instances lie within
            their cells; None for the released convention.
        truth: Truth with the actors that can be named.
        reading: How an accident is read off maps.
    """
    if isinstance(prediction, MotionOutput):
        config = label.config if label else _RELEASED_LABELS
        alarms = _alarms_of_maps(prediction, config, truth, reading)
    else:
        alarms = [(accident, _named(accident, truth)) for accident in prediction]
    counted = [alarm for alarm in alarms if alarm[0].score >= MIN_SCORE]
    return sorted(counted, key=lambda alarm: by_sureness(alarm[0]))


def within_horizon(alarms: list[NamedAlarm], truth: BoxTruth) -> list[NamedAlarm]:
    """Return the alarms up to half a recorded frame after the horizon; others do not count."""
    latest = truth.horizon + TIME_TOLERANCE_S
    return [alarm for alarm in alarms if alarm[0].time <= latest]


def by_sureness(alarm: Accident) -> tuple[Any, ...]:
    """Return the sort key for the surest alarm first, of equally sure ones the earliest.

    Its other parts make the order independent of the list's order.
    """
    return -alarm.score, alarm.time, alarm.positions.tolist(), alarm.ids or ()


def nearest_two(positions: FloatArray, identity: IntArray, center: FloatArray, gate: float) -> Pair:
    """Return the two actors nearest to two positions, by the least sum of distances.

    Args:
        positions: (2, 2) x forward, y left, metres.
        identity: (I,) int64 ids of actors that can be named, ascending.
        center: (I, 2) their positions, in the same frame; NaN where an actor is missing.
        gate: Metres: an actor that is farther away is not named.
    """
    position_tracks = InstanceTracks(identity=np.arange(2), center=positions[None])
    match = match_tracks(
        position_tracks, InstanceTracks(identity=identity, center=center[None]), gate
    )
    return match.get(0), match.get(1)


def position_difference(first: FloatArray, second: FloatArray) -> float:
    """Return the difference of two pairs of positions (2, 2), metres.

    It is the sum of the two distances, in the order that fits better.
    """
    apart = np.linalg.norm(first[:, None] - second, axis=-1)
    in_order = apart.trace()
    in_reverse = apart[::-1].trace()
    return float(min(in_order, in_reverse))


def _named(alarm: Accident, truth: BoxTruth) -> Pair:
    """Return the actors that an explicit accident names."""
    if alarm.ids is not None:
        return alarm.ids
    frame = min(round(alarm.time / FRAME_PERIOD), len(truth.time) - 1)
    centers = truth.footprint[frame, :, :2]
    return nearest_two(alarm.positions, truth.actor_id, centers, MATCH_DISTANCE)


def foreseen_accident(
    output: MotionOutput, *, step: float = LABEL_STEP, labels: str | None = "released"
) -> Accident | None:
    """Return the accident that K motion predictions foresee together, as the protocol `boxes` does.

    Its score is the share of the predictions that have one. The mean sample (the last) gives place
    and time or, if it has none, the first that has one.

    Args:
        output: Predictions of a sample.
        step: Seconds from one frame to the next.
        labels: Protocol of the labels that the predictions are, or were learned from: where it has
            the half-cell shift, that is undone in positions. None for predictions without any.

    Returns:
        The accident without ids, which maps do not know; None if no prediction has one.

    Raises:
        ChoiceError: no such labels.
    """
    labels = choice("labels", labels, (None, *LABEL_PROTOCOLS))
    rules = None if labels is None else LABEL_PROTOCOLS[labels]
    predictions = predicted_accidents(output, rules, AccidentReading())
    accidents = _mean_first(predictions)
    return _joint(accidents, len(predictions), step) if accidents else None


def _mean_first(
    predictions: list[InstanceAccident],
) -> list[tuple[InstanceAccident, MapContact]]:
    """Return the predictions with an accident, and their contacts; the mean's comes first."""
    accidents = []
    for prediction in (*predictions[-1:], *predictions[:-1]):
        if prediction.contact is not None:
            accidents.append((prediction, prediction.contact))
    return accidents


def _joint(
    accidents: list[tuple[InstanceAccident, MapContact]], prediction_count: int, step: float
) -> Accident:
    """Return the first accident, with the share of predictions that have one as its score."""
    accident, contact = accidents[0]
    score = len(accidents) / prediction_count
    return Accident(positions=accident.positions, time=contact.frame * step, score=score)


def _alarms_of_maps(
    output: MotionOutput, config: MotionLabelConfig, truth: BoxTruth, reading: AccidentReading
) -> list[NamedAlarm]:
    """Return the alarm of K predictions and the actors that it names; empty without one."""
    seconds = config.step * FRAME_PERIOD
    predictions = predicted_accidents(output, config.rules, reading)
    accidents = _mean_first(predictions)
    if not accidents:
        return []
    accident, contact = accidents[0]
    true_tracks = truth.tracks(seconds, len(accident.tracks.center))
    match = match_tracks(accident.tracks, true_tracks, MATCH_DISTANCE)
    pair = match.get(contact.ids[0]), match.get(contact.ids[1])
    return [(_joint(accidents, len(predictions), seconds), pair)]
