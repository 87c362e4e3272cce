"""Forecasts from predicted motion: paths of instances, matched to actors in the current frame."""

import numpy as np

from deepaccident_devkit.evaluation.alarms import LABEL_STEP, MATCH_DISTANCE
from deepaccident_devkit.evaluation.forecasting.metrics import Forecast
from deepaccident_devkit.evaluation.map_accidents import (
    InstanceTracks,
    match_tracks,
    predicted_tracks,
)
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.motion import LABEL_PROTOCOLS
from deepaccident_devkit.support.arrays import FloatArray, IntArray
from deepaccident_devkit.support.text import choice


def forecasts_of(
    output: MotionOutput,
    actor_id: IntArray,
    present: FloatArray,
    *,
    step: float = LABEL_STEP,
    labels: str | None = "released",
) -> list[Forecast]:
    """Derive forecasts of actors from K motion predictions of a sample.

    Maps have no actor ids. So in each prediction, the instances of the current frame are matched
    with the true actors, one to one, within 4 m. Each prediction is a mode of probability 1/K. The
    mean prediction, which is the last in the released order and which the motion metrics use, is
    the first mode; so it is the one that counts for K = 1.

    A mode ends where its instance is first missing. An actor's forecast is as long as its longest
    mode; shorter modes are left out. An actor has no forecast if no instance matches it, or if its
    instance is missing after the current frame.

    Args:
        output: Predictions, in the current ego frame.
        actor_id: (A,) ids of the true actors, ascending.
        present: (A, 2) current centres of the true actors, x forward, y left, metres in the current
            ego frame.
        step: Seconds from one frame to the next.
        labels: Label protocol, as for `foreseen_accident`.

    Raises:
        ChoiceError: If `labels` is not the name of a label protocol.
    """
    labels = choice("labels", labels, (None, *LABEL_PROTOCOLS))
    rules = None if labels is None else LABEL_PROTOCOLS[labels]
    predictions = predicted_tracks(output, rules)
    truth = InstanceTracks(identity=actor_id, center=present[None])
    paths_by_actor: dict[int, list[FloatArray]] = {}
    for tracks in (*predictions[-1:], *predictions[:-1]):
        present_tracks = InstanceTracks(identity=tracks.identity, center=tracks.center[:1])
        for instance, actor in match_tracks(present_tracks, truth, MATCH_DISTANCE).items():
            path = tracks.center[:, tracks.identity.searchsorted(instance)]
            paths_by_actor.setdefault(actor, []).append(_future_path(path))
    forecasts = []
    for actor, paths in sorted(paths_by_actor.items()):
        frame_count = max(map(len, paths))
        if not frame_count:
            continue
        longest_paths = np.array([path for path in paths if len(path) == frame_count])
        forecast = Forecast(
            actor_id=actor,
            times=np.arange(1.0, frame_count + 1) * step,
            paths=longest_paths,
            probabilities=np.full(len(longest_paths), 1 / len(predictions)),
        )
        forecasts.append(forecast)
    return forecasts


def _future_path(path: FloatArray) -> FloatArray:
    """Cut a path (T, 2) to the frames after the current one and before the first NaN."""
    is_missing = ~np.isfinite(path[:, 0])
    if not is_missing.any():
        return path[1:]
    first_missing = np.argmax(is_missing)
    return path[1:first_missing]
