"""Alarms in predictions: explicit accidents, or those read off motion maps, and the actors that they name."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from deepaccident_devkit.evaluation.map_accidents import (
    AccidentReading,
    Contact,
    InstanceAccident,
    InstanceTracks,
    match_tracks,
    predicted_accidents,
)
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput
from deepaccident_devkit.evaluation.truth import SLACK, BoxTruth
from deepaccident_devkit.motion import LABEL_PROTOCOLS, MotionLabelConfig, MotionLabels
from deepaccident_devkit.support.arrays import FloatArray, IntArray
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.taxonomy import FRAME_PERIOD

# Seconds from one frame of the released labels to the next.
LABEL_STEP: Final = 0.5
# Metres: gate of the matches that decide which actors an alarm names.
MATCH_DISTANCE: Final = 4.0
# Alarms with a lower score do not count.
LEAST_SCORE: Final = 0.0
# Ids of the actors named; None for an unknown one.
Pair = tuple[int | None, int | None]
# An alarm and whom it names.
NamedAlarm = tuple[Accident, Pair]
_RELEASED_LABELS: Final = MotionLabelConfig()


def named_alarms(
    prediction: MotionOutput | list[Accident],
    label: MotionLabels | None,
    truth: BoxTruth,
    reading: AccidentReading,
) -> list[NamedAlarm]:
    """The alarms of one sample, the surest first, of equally sure ones the earliest.

    K motion predictions are at most one alarm, whose score is the share of them that have an accident. The mean sample
    (the last) says where and when, or if it has no accident, the first that has one. An explicit accident without
    `ids` (actor ids) names the two whose boxes' centres are nearest to its positions at its time (at the last moment of
    the truth, if it is for later).

    Args:
        prediction: motion in maps, or explicit accidents.
        label: says how far apart in time maps are and how they lie in their cells; None for the released way.
        truth: the actors that can be named.
        reading: how an accident is read off maps.
    """
    if isinstance(prediction, MotionOutput):
        found = _alarms_of_maps(
            prediction, label.config if label else _RELEASED_LABELS, truth, reading
        )
    else:
        found = [(alarm, _named(alarm, truth)) for alarm in prediction]
    return sorted(
        (each for each in found if each[0].score >= LEAST_SCORE),
        key=lambda each: by_sureness(each[0]),
    )


def within_horizon(alarms: list[NamedAlarm], truth: BoxTruth) -> list[NamedAlarm]:
    """The alarms within the horizon of the predictions and half a recorded frame; others do not count."""
    return [each for each in alarms if each[0].time <= truth.horizon + SLACK]


def by_sureness(alarm: Accident) -> tuple[Any, ...]:
    """The surest first, of equally sure ones the earliest; other keys make it independent of the list's order."""
    return -alarm.score, alarm.time, alarm.positions.tolist(), alarm.ids or ()


def nearest_two(positions: FloatArray, identity: IntArray, center: FloatArray, gate: float) -> Pair:
    """The two actors nearest to two positions, by the least sum of distances.

    Args:
        positions: (2, 2) x forward, y left, metres.
        identity: (I,) int64, ascending: of actors that can be named.
        center: (I, 2) where they are, in the same frame; NaN where they are not.
        gate: metres: an actor that is farther away is not named.
    """
    places = InstanceTracks(identity=np.arange(2), center=positions[None])
    match = match_tracks(places, InstanceTracks(identity=identity, center=center[None]), gate)
    return match.get(0), match.get(1)


def position_difference(first: FloatArray, second: FloatArray) -> float:
    """The differences of two pairs of positions (2, 2), metres: the sum over the two, in the order that fits better."""
    apart = np.linalg.norm(first[:, None] - second, axis=-1)
    return float(min(apart.trace(), apart[::-1].trace()))


def _named(alarm: Accident, truth: BoxTruth) -> Pair:
    if alarm.ids is not None:
        return alarm.ids
    frame = min(round(alarm.time / FRAME_PERIOD), len(truth.time) - 1)
    return nearest_two(
        alarm.positions, truth.actor_id, truth.footprint[frame, :, :2], MATCH_DISTANCE
    )


def foreseen_accident(
    output: MotionOutput, *, step: float = LABEL_STEP, labels: str | None = "released"
) -> Accident | None:
    """The accident that K motion predictions of a sample foresee together, as the protocol `boxes` reads them.

    Its score is the share of the predictions that have one. The mean sample (the last) says where and when or, if it
    has none, the first that has one.

    Args:
        output: the predictions.
        step: seconds from one frame to the next.
        labels: protocol of the labels that they are, or were learned from: where it has the half-cell shift, that is
            undone in positions. None for predictions without any.

    Returns:
        The accident without ids, which maps do not know; None if no prediction has one.

    Raises:
        ChoiceError: no such labels.
    """
    labels = choice("labels", labels, (None, *LABEL_PROTOCOLS))
    read = predicted_accidents(
        output, None if labels is None else LABEL_PROTOCOLS[labels], AccidentReading()
    )
    there = _surest_first(read)
    return _joint(there, len(read), step) if there else None


def _surest_first(read: list[InstanceAccident]) -> list[tuple[InstanceAccident, Contact]]:
    """Those with an accident; the mean's before all others."""
    return [(each, each.contact) for each in (*read[-1:], *read[:-1]) if each.contact is not None]


def _joint(
    there: list[tuple[InstanceAccident, Contact]], predictions: int, step: float
) -> Accident:
    found, contact = there[0]
    return Accident(
        positions=found.positions, time=contact.frame * step, score=len(there) / predictions
    )


def _alarms_of_maps(
    output: MotionOutput, config: MotionLabelConfig, truth: BoxTruth, reading: AccidentReading
) -> list[NamedAlarm]:
    """At most one alarm of K predictions."""
    seconds = config.step * FRAME_PERIOD
    read = predicted_accidents(output, config.rules, reading)
    there = _surest_first(read)
    if not there:
        return []
    found, contact = there[0]
    match = match_tracks(
        found.tracks, truth.tracks(seconds, len(found.tracks.center)), MATCH_DISTANCE
    )
    return [
        (_joint(there, len(read), seconds), (match.get(contact.ids[0]), match.get(contact.ids[1])))
    ]
