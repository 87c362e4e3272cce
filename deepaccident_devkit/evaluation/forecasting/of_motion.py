"""Forecasts out of predicted motion: the paths of its instances, for the actors that they are at the present."""

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
    """Actors' paths, as K motion predictions of a sample show them.

    Maps do not know ids: the instances of the present frame are matched with the true actors, one to one, within 4 m,
    in each prediction apart. Each prediction is a mode of probability 1/K. The mean sample, which comes last in the
    released order and which the metrics of motion take, is the first mode, and so the one that counts for K = 1.

    An actor's forecast goes on as long as one of its instances is in each frame; modes that end earlier are left out.
    There is none of an actor without an instance, or with one in the present frame alone.

    Args:
        output: the predictions, in the present ego frame.
        actor_id: (A,) the true actors, ascending.
        present: (A, 2) where their centres are, x forward, y left, metres in the present ego frame.
        step: seconds from one frame to the next.
        labels: as of `foreseen_accident`.

    Raises:
        ChoiceError: no such labels.
    """
    labels = choice("labels", labels, (None, *LABEL_PROTOCOLS))
    predicted = predicted_tracks(output, None if labels is None else LABEL_PROTOCOLS[labels])
    truth = InstanceTracks(identity=actor_id, center=present[None])
    modes: dict[int, list[FloatArray]] = {}
    for tracks in (*predicted[-1:], *predicted[:-1]):
        now = InstanceTracks(identity=tracks.identity, center=tracks.center[:1])
        for instance, actor in match_tracks(now, truth, MATCH_DISTANCE).items():
            path = tracks.center[:, tracks.identity.searchsorted(instance)]
            there = np.isfinite(path[:, 0])
            modes.setdefault(actor, []).append(
                path[1 : len(path) if there.all() else int(np.argmin(there))]
            )
    forecasts = []
    for actor, paths in sorted(modes.items()):
        frames = max(map(len, paths))
        kept = np.array([path for path in paths if len(path) == frames])
        if frames:
            times, chances = (
                np.arange(1.0, frames + 1) * step,
                np.full(len(kept), 1 / len(predicted)),
            )
            forecasts.append(
                Forecast(actor_id=actor, times=times, paths=kept, probabilities=chances)
            )
    return forecasts
