"""Alarms in predictions: explicit accidents, or accidents in motion maps, and their actors."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.drawing import (
    Drawing,
    DrawnAlarm,
    DrawnPath,
    DrawnPlaces,
    drawn_pair,
    joined_drawing,
)
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
# An alarm only names actors that are at most this far away, metres.
MATCH_DISTANCE: Final = 4.0
# Alarms with a lower score do not count.
MIN_SCORE: Final = 0.0
# Ids of the named actors; None for an unknown one.
Pair = tuple[int | None, int | None]
# An alarm and the actors that it names.
NamedAlarm = tuple[Accident, Pair]
_RELEASED_LABELS = MotionLabelConfig()


def named_alarms(
    prediction: MotionOutput | list[Accident],
    label: MotionLabels | None,
    truth: BoxTruth,
    reading: AccidentReading,
) -> list[NamedAlarm]:
    """Return the alarms of one sample, in descending order of score, with the actors they name.

    Alarms with equal scores are ordered by time. K motion predictions raise at most one alarm; its
    score is the share of the predictions that contain an accident. The mean prediction (the last)
    sets the positions and the time; if it contains no accident, the first prediction that contains
    one does. An explicit accident without `ids` (actor ids) names the two actors whose box centres
    are nearest to its positions at its time, or in the last frame of the truth if it is later.

    Args:
        prediction: Motion in maps, or explicit accidents.
        label: Labels that define the time between maps, and where instances lie within their cells;
            None for the released convention.
        truth: Boxes of the actors that can be named.
        reading: Definition of an accident in maps.
    """
    if isinstance(prediction, MotionOutput):
        config = _RELEASED_LABELS
        if label:
            config = label.config
        alarms = _read_map_alarm(prediction, config, truth, reading)
    else:
        alarms = [(accident, _name_actors(accident, truth)) for accident in prediction]
    counted_alarms = [alarm for alarm in alarms if alarm[0].score >= MIN_SCORE]
    return sorted(counted_alarms, key=lambda alarm: alarm_sort_key(alarm[0]))


def drawing_of_alarms(
    dataset: Dataset,
    token: str,
    true: Accident | None,
    alarms: Sequence[Accident],
    truth: BoxTruth,
    threshold: float,
) -> Drawing:
    """Describe alarms, the true accident and the colliding pair for a picture.

    Args:
        dataset: The release.
        token: Token of the sample.
        true: The accident that follows; None for none.
        alarms: Alarms in descending order of score.
        truth: Boxes of all actors.
        threshold: Lowest score that raises an alarm.
    """
    paths: tuple[DrawnPath, ...] = ()
    places = joined_drawing(alarms).places
    if true is not None:
        actual = DrawnPlaces(
            xy=true.positions,
            time=true.time,
            role="collision",
            note=f"in {true.time:.1f} s",
            label="actual collision",
        )
        places = (actual, *places)
        paths = _drawn_pair_paths(true, truth)
    alarm = DrawnAlarm(score=0.0, fires=False)
    if alarms:
        score = alarms[0].score
        alarm = DrawnAlarm(score=score, fires=score >= threshold)
    return Drawing(
        paths=paths,
        boxes=drawn_pair(dataset, token),
        places=places,
        alarm=alarm,
        words=_alarm_words(true, alarms, truth, fires=alarm.fires),
    )


def _drawn_pair_paths(true: Accident, truth: BoxTruth) -> tuple[DrawnPath, ...]:
    """Describe the paths of the pair that the truth names, up to the impact."""
    impact = truth.impact or truth.accident
    if impact is None or impact.ids is None:
        return ()
    is_before = truth.time <= true.time + TIME_TOLERANCE_S
    paths = []
    for column in np.flatnonzero(np.isin(truth.actor_id, impact.ids)).tolist():
        xy = truth.footprint[:, column, :2]
        is_drawn = is_before & np.isfinite(xy[:, 0])
        if is_drawn.sum() > 1:
            path = DrawnPath(
                xy=xy[is_drawn],
                times=truth.time[is_drawn],
                role="collision",
                label="path to the collision",
            )
            paths.append(path)
    return tuple(paths)


def _alarm_words(
    true: Accident | None, alarms: Sequence[Accident], truth: BoxTruth, *, fires: bool
) -> str:
    """State when an accident follows, and the errors of the most confident alarm if it fires."""
    words = "no collision ahead"
    if true is not None:
        words = f"collision in {true.time:.1f} s"
    elif truth.unplaced is not None:
        words = f"collision in {truth.unplaced:.1f} s, but no label shows both actors"
    if not alarms:
        return f"{words}; no alarm"
    alarm = alarms[0]
    if not fires:
        return f"{words}; no alarm, with a score of {alarm.score:.2g}"
    words = f"{words}; alarm for a collision {alarm.words}"
    if true is None:
        return words
    difference = position_difference(alarm.positions, true.positions)
    return f"{words}: {error_words(difference, alarm.time - true.time)}"


def error_words(position_error: float, delay: float) -> str:
    """Describe an alarm's errors: `position error 3.2 m (both actors), 0.5 s late`."""
    timing = "on time"
    if round(delay, 1):
        timing = f"{abs(delay):.1f} s {'late' if delay > 0 else 'early'}"
    return f"position error {position_error:.1f} m (both actors), {timing}"


def within_horizon(alarms: list[NamedAlarm], truth: BoxTruth) -> list[NamedAlarm]:
    """Return the alarms whose time is at most half a recorded frame after the horizon."""
    latest = truth.horizon + TIME_TOLERANCE_S
    return [alarm for alarm in alarms if alarm[0].time <= latest]


def alarm_sort_key(alarm: Accident) -> tuple[Any, ...]:
    """Return a key that sorts alarms in descending order of score, then by time.

    Further parts of the key make the result independent of the order of the list.
    """
    positions = alarm.positions.tolist()
    ids = alarm.ids or ()
    return -alarm.score, alarm.time, positions, ids


def nearest_two(positions: FloatArray, identity: IntArray, center: FloatArray, gate: float) -> Pair:
    """Return the ids of the two actors nearest to two positions, by the smallest sum of distances.

    Args:
        positions: (2, 2) x forward, y left, metres.
        identity: (I,) int64 ids of actors that can be named, ascending.
        center: (I, 2) positions of these actors, in the same frame; NaN where one is missing.
        gate: An actor that is farther away than this is not named, metres.
    """
    position_tracks = InstanceTracks(identity=np.arange(2), center=positions[None])
    actor_tracks = InstanceTracks(identity=identity, center=center[None])
    actor_by_position = match_tracks(position_tracks, actor_tracks, gate)
    return actor_by_position.get(0), actor_by_position.get(1)


def position_difference(first: FloatArray, second: FloatArray) -> float:
    """Return the difference in metres between two pairs of positions, shape (2, 2) each.

    It is the sum of the two distances, for the better of the two ways to pair the positions.
    """
    distances = np.linalg.norm(first[:, None] - second, axis=-1)
    sum_in_order = distances.trace()
    sum_in_reverse = distances[::-1].trace()
    return float(min(sum_in_order, sum_in_reverse))


def _name_actors(alarm: Accident, truth: BoxTruth) -> Pair:
    """Return the ids of the two actors that an explicit accident names; None for an unknown one."""
    if alarm.ids is not None:
        return alarm.ids
    frame = min(round(alarm.time / FRAME_PERIOD), len(truth.time) - 1)
    centers = truth.footprint[frame, :, :2]
    return nearest_two(alarm.positions, truth.actor_id, centers, MATCH_DISTANCE)


def foreseen_accident(
    output: MotionOutput, *, step: float = LABEL_STEP, labels: str | None = "released"
) -> Accident | None:
    """Merge the accidents in K motion predictions to a single one, as the protocol `boxes` does.

    Its score is the share of the predictions that contain an accident. The mean prediction (the
    last) sets the positions and the time; if it contains no accident, the first prediction that
    contains one does.

    Args:
        output: Predictions of a sample.
        step: Seconds from one frame to the next.
        labels: Protocol of the labels that the model was trained on, or that the maps were made
            from. If it shifts maps by half a cell, the shift is undone in positions. None if there
            are no such labels.

    Returns:
        The accident, without ids, since maps have no actor ids; None if no prediction has one.

    Raises:
        ChoiceError: If the label protocol does not exist.
    """
    labels = choice("labels", labels, (None, *LABEL_PROTOCOLS))
    rules = None if labels is None else LABEL_PROTOCOLS[labels]
    predictions = predicted_accidents(output, rules, AccidentReading())
    accidents = _list_accidents(predictions)
    if not accidents:
        return None
    return _merge_accidents(accidents, len(predictions), step)


def _list_accidents(
    predictions: list[InstanceAccident],
) -> list[tuple[InstanceAccident, MapContact]]:
    """Return the predictions that contain an accident, with their contacts; the mean is first."""
    accidents = []
    for prediction in (*predictions[-1:], *predictions[:-1]):
        if prediction.contact is not None:
            accidents.append((prediction, prediction.contact))
    return accidents


def _merge_accidents(
    accidents: list[tuple[InstanceAccident, MapContact]], prediction_count: int, step: float
) -> Accident:
    """Return the first accident, with the share of the predictions that have one as its score."""
    accident, contact = accidents[0]
    score = len(accidents) / prediction_count
    return Accident(positions=accident.positions, time=contact.frame * step, score=score)


def _read_map_alarm(
    output: MotionOutput, config: MotionLabelConfig, truth: BoxTruth, reading: AccidentReading
) -> list[NamedAlarm]:
    """Return a list with the single alarm that K predictions raise; empty if they raise none."""
    step_s = config.step * FRAME_PERIOD
    predictions = predicted_accidents(output, config.rules, reading)
    accidents = _list_accidents(predictions)
    if not accidents:
        return []
    accident, contact = accidents[0]
    true_tracks = truth.tracks(step_s, len(accident.tracks.center))
    actor_by_instance = match_tracks(accident.tracks, true_tracks, MATCH_DISTANCE)
    first_id, second_id = contact.ids
    pair = actor_by_instance.get(first_id), actor_by_instance.get(second_id)
    return [(_merge_accidents(accidents, len(predictions), step_s), pair)]
