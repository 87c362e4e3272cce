"""Forecasts from predicted motion: the paths of its instances, matched to actors at the present."""

from __future__ import annotations

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
    """Return actors' paths from K motion predictions of a sample.

    Maps do not know ids: the instances of the present frame are matched with the true actors, one
    to one, within 4 m, in each prediction separately. Each prediction is a mode of probability 1/K.
    The mean sample, which comes last in the released order and which the metrics of motion use, is
    the first mode, and so the one that counts for K = 1.

    An actor's forecast goes on as long as one of its instances is in each frame; modes that end
    earlier are left out. An actor without an instance, or with one only in the present frame, has
    no forecast.

    Args:
        output: Predictions, in the present ego frame.
        actor_id: (A,) ids of the true actors, ascending.
        present: (A, 2) their centres, x forward, y left, metres in the present ego frame.
        step: Seconds from one frame to the next.
        labels: Label protocol, as for `foreseen_accident`.

    Raises:
        ChoiceError: no such labels.
    """
    labels = choice("labels", labels, (None, *LABEL_PROTOCOLS))
    predicted = predicted_tracks(output, None if labels is None else LABEL_PROTOCOLS[labels])
    truth = InstanceTracks(identity=actor_id, center=present[None])
    modes: dict[int, list[FloatArray]] = {}
    for tracks in (*predicted[-1:], *predicted[:-1]):
        present_tracks = InstanceTracks(identity=tracks.identity, center=tracks.center[:1])
        for instance, actor in match_tracks(present_tracks, truth, MATCH_DISTANCE).items():
            path = tracks.center[:, tracks.identity.searchsorted(instance)]
            modes.setdefault(actor, []).append(_future(path))
    forecasts = []
    for actor, paths in sorted(modes.items()):
        frames = max(map(len, paths))
        if not frames:
            continue
        longest_paths = np.array([path for path in paths if len(path) == frames])
        forecast = Forecast(
            actor_id=actor,
            times=np.arange(1.0, frames + 1) * step,
            paths=longest_paths,
            probabilities=np.full(len(longest_paths), 1 / len(predicted)),
        )
        forecasts.append(forecast)
    return forecasts


def _future(path: FloatArray) -> FloatArray:
    """Return a path (T, 2) after the present up to the first frame without the instance (NaN)."""
    is_present = np.isfinite(path[:, 0])
    end = len(path) if is_present.all() else int(np.argmin(is_present))
    return path[1:end]
