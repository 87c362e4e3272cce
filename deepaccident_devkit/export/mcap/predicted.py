"""A model's predictions for a scenario's samples, in addition to the labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from foxglove_schemas_protobuf.SpherePrimitive_pb2 import SpherePrimitive

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation.metrics.detection import DetectedBoxes
from deepaccident_devkit.evaluation.metrics.predictions import Accident, MotionOutput
from deepaccident_devkit.evaluation.results import Prediction, Results
from deepaccident_devkit.export.mcap.cells import cell_points
from deepaccident_devkit.export.mcap.config import Predictions
from deepaccident_devkit.export.mcap.drawing import (
    box_segments,
    colored_points,
    cube,
    entity,
    joined,
    label,
    lines,
    scene_update,
    segment_points,
)
from deepaccident_devkit.export.mcap.messages import cloud_message, color_message, frame_id, pose, vector
from deepaccident_devkit.export.mcap.moment import Moment
from deepaccident_devkit.export.mcap.recording import Recording
from deepaccident_devkit.motion import predict_instances
from deepaccident_devkit.render.colors import PREDICTED_COLOR
from deepaccident_devkit.taxonomy import CATEGORIES

_MARK: Final = 1.0
"""Diameter of the spheres where an accident is predicted, metres."""
_MARK_HEIGHT: Final = 1.0


class PredictedScenes:
    """Renders predictions of moments, on topics below `/<agent>/prediction`."""

    def __init__(self, prediction: Predictions) -> None:
        """Take predictions by sample token; raises ConfigError for other objects."""
        if not isinstance(prediction, Results | Mapping):
            raise ConfigError(
                "prediction: expected Results, or a mapping from sample token to what is predicted, "
                f"found {type(prediction).__name__}"
            )
        self._prediction = prediction

    def has(self, sample: str) -> bool:
        """Whether a sample has a prediction."""
        return sample in self._prediction

    def write(self, moment: Moment, recording: Recording) -> None:
        """Write the predictions of a moment's samples; raises ConfigError or ResultsError."""
        for agent, sample in moment.samples.items():
            if self.has(sample):
                _write(agent, self._of(sample), moment.index, recording)

    def _of(self, sample: str) -> Prediction:
        if isinstance(self._prediction, Results):
            return self._prediction.prediction(sample)
        return self._prediction[sample]


def _write(agent: str, prediction: object, index: int, recording: Recording) -> None:
    topic = f"/{agent}/prediction"
    if isinstance(prediction, MotionOutput):
        points = cell_points(_instances(prediction), prediction.grid)
        recording.write(f"{topic}/motion/points", cloud_message(points, frame_id(agent, "ego"), index), index)
    elif isinstance(prediction, DetectedBoxes):
        _write_boxes(agent, prediction, f"{topic}/boxes", index, recording)
    elif isinstance(prediction, Sequence) and all(isinstance(each, Accident) for each in prediction):
        _write_accidents(agent, prediction, f"{topic}/accidents", index, recording)
    else:
        raise ConfigError(
            "prediction: expected a MotionOutput, a list of Accident or DetectedBoxes for each sample, found "
            f"{type(prediction).__name__}"
        )


def _instances(output: MotionOutput) -> Any:
    """The instances (T, H, W) of the last prediction, in the grid's orientation."""
    if output.heads is not None:
        return predict_instances(output.heads[-1], "motion").instance
    return np.asarray(output.instances)[-1]


def _write_boxes(agent: str, detected: DetectedBoxes, topic: str, index: int, recording: Recording) -> None:
    boxes, frame = detected.boxes, frame_id(agent, detected.boxes.frame)
    segments = box_segments(boxes)
    entities = [
        entity(
            str(row),
            frame,
            index,
            {"category": CATEGORIES[boxes.category[row]], "score": f"{score:.3f}"},
            cubes=[cube(boxes, row, PREDICTED_COLOR)],
            lines=[lines(segments[row], PREDICTED_COLOR)],
        )
        for row, score in enumerate(detected.scores.tolist())
    ]
    recording.write(topic, scene_update(entities, index), index)
    points = segment_points(segments.reshape(-1, 2, 3), PREDICTED_COLOR)
    recording.write(f"{topic}/points", cloud_message(points, frame, index), index)


def _write_accidents(agent: str, accidents: Sequence[Accident], topic: str, index: int, recording: Recording) -> None:
    frame, entities, points = frame_id(agent, "ego"), [], []
    for number, accident in enumerate(accidents):
        places = np.column_stack([accident.positions, np.full(2, _MARK_HEIGHT)])
        text = f"accident in {accident.time:.1f} s (score {accident.score:.2f})"
        facts = {"text": text, "time": f"{accident.time:.3f}", "score": f"{accident.score:.3f}"}
        if accident.ids is not None:
            facts["actor_ids"] = ", ".join(map(str, accident.ids))
        entities.append(
            entity(
                str(number),
                frame,
                index,
                facts,
                spheres=[_sphere(place) for place in places],
                lines=[lines(places[None], PREDICTED_COLOR)],
                texts=[label(text, places.mean(axis=0) + np.array([0.0, 0.0, _MARK]), PREDICTED_COLOR)],
            )
        )
        points += [colored_points(places, PREDICTED_COLOR), segment_points(places[None], PREDICTED_COLOR)]
    recording.write(topic, scene_update(entities, index), index)
    recording.write(f"{topic}/points", cloud_message(joined(points), frame, index), index)


def _sphere(place: Any) -> Any:
    turn = np.array([1.0, 0.0, 0.0, 0.0])
    return SpherePrimitive(
        pose=pose(place, turn), size=vector(np.full(3, _MARK)), color=color_message(PREDICTED_COLOR, 0.8)
    )
