"""Motion labels as coloured points, one for each cell of an actor; and what a model predicts, beside the labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from foxglove_schemas_protobuf.SpherePrimitive_pb2 import SpherePrimitive

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.export.mcap import Predictions
from deepaccident_devkit.export.mcap.messages import (
    COLORED_POINT,
    McapRecording,
    Moment,
    Roles,
    box_segments,
    cloud_message,
    color_message,
    colored_points,
    cube,
    entity,
    frame_id,
    joined,
    label,
    lines,
    pose,
    rgb,
    scene_update,
    segment_points,
    vector,
)
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import (
    OWN_BOX_ID,
    MotionLabelConfig,
    MotionLabels,
    motion_labels_of,
    predict_instances,
)
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    COLLIDER_COLOR,
    INSTANCE_COLORS,
    PREDICTED_COLOR,
)
from deepaccident_devkit.support.arrays import AnyArray, BoolArray
from deepaccident_devkit.taxonomy import CATEGORIES

CELL_POINT: Final = np.dtype(
    [
        *((name, COLORED_POINT[name].str) for name in COLORED_POINT.names or ()),
        ("instance", "<i4"),
        ("frame", "<i4"),
    ]
)
"""A point of a map: `instance` is the map's id, `frame` counts from 0, the present."""
FRAME_HEIGHT: Final = 0.2
"""Metres from each future frame up to the next one, so that no frame hides another."""
# The share of its opacity that an instance has lost at the last frame.
_FADING: Final = 0.6
# Diameter of the spheres where an accident is predicted, metres.
_MARK: Final = 1.0
_MARK_HEIGHT: Final = 1.0


class MotionMapMessages:
    """Renders the motion labels of moments in the agents' ego frames."""

    def __init__(self, dataset: Dataset, scenario: str, config: MotionLabelConfig) -> None:
        """Prepare the labels of a scenario."""
        self._dataset, self._config = dataset, config
        self._roles = Roles(dataset, scenario)

    def write(self, moment: Moment, recording: McapRecording) -> None:
        """Write the motion labels of the samples of a moment that have labels."""
        records = {
            agent: self._dataset.get("sample", sample) for agent, sample in moment.samples.items()
        }
        labelled = {agent: record for agent, record in records.items() if record["labelled"]}
        made = motion_labels_of(self._dataset, labelled.values(), self._config)
        for (agent, record), labels in zip(labelled.items(), made, strict=True):
            own = self._dataset.get("agent", record["agent_token"])["actor_id"]
            points = self._points(labels.to_present(), agent, own)
            message = cloud_message(points, frame_id(agent, "ego"), moment.index)
            recording.write(f"/{agent}/motion_labels/points", message, moment.index)

    def _points(self, labels: MotionLabels, agent: str, own_actor: int | None) -> AnyArray:
        actors = {
            own_actor if actor == OWN_BOX_ID else actor: name
            for actor, name in labels.id_map.items()
        }
        colors = {
            name: AGENT_COLORS[agent]
            for actor, name in labels.id_map.items()
            if actor == OWN_BOX_ID
        }
        for actor, name in actors.items():
            if actor in self._roles.pair:
                colors[name] = COLLIDER_COLOR
            elif actor is not None and actor in self._roles.agents:
                colors[name] = AGENT_COLORS[self._roles.agents[actor]]
        return cell_points(labels.instance, labels.config.grid, labels.label_valid, colors)


def cell_points(
    instance: AnyArray,
    grid: BevGrid,
    valid: BoolArray | None = None,
    colors: Mapping[int, str] | None = None,
) -> AnyArray:
    """The cells of instance maps (T, H, W) as points (N,) of `CELL_POINT`, by frame; later frames are paler and higher.

    All frames are in the present ego frame; `valid` (T,) are those that count. Ids without a colour have those of a
    palette.
    """
    count = len(instance)
    shown = instance > 0
    if valid is not None:
        shown &= valid[:, None, None]
    frame, row, column = np.nonzero(shown)
    ids = instance[frame, row, column]
    names, which = np.unique(ids, return_inverse=True)
    points = np.zeros(len(ids), dtype=CELL_POINT)
    points["x"], points["y"] = grid.centers()[row, column].T
    points["z"] = frame * FRAME_HEIGHT
    table = _colors(names.tolist(), colors or {})[which.reshape(-1)]
    points["red"], points["green"], points["blue"] = table.T
    points["alpha"] = np.rint(255 * (1 - _FADING * frame / max(count - 1, 1)))
    points["instance"], points["frame"] = ids, frame
    return points


def _colors(names: Sequence[int], chosen: Mapping[int, str]) -> AnyArray:
    colors: Any = [
        rgb(chosen.get(name, INSTANCE_COLORS[name % len(INSTANCE_COLORS)])) for name in names
    ]
    return np.array(colors, dtype=np.uint8).reshape(-1, 3)


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

    def write(self, moment: Moment, recording: McapRecording) -> None:
        """Write the predictions of a moment's samples; raises ConfigError or ResultsError."""
        for agent, sample in moment.samples.items():
            if self.has(sample):
                given = self._prediction
                found = given.prediction(sample) if isinstance(given, Results) else given[sample]
                _write(agent, found, moment.index, recording)


def _write(agent: str, prediction: object, index: int, recording: McapRecording) -> None:
    topic = f"/{agent}/prediction"
    if isinstance(prediction, MotionOutput):
        points = cell_points(_instances(prediction), prediction.grid)
        recording.write(
            f"{topic}/motion/points", cloud_message(points, frame_id(agent, "ego"), index), index
        )
    elif isinstance(prediction, DetectedBoxes):
        _write_boxes(agent, prediction, f"{topic}/boxes", index, recording)
    elif isinstance(prediction, Sequence) and all(
        isinstance(each, Accident) for each in prediction
    ):
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


def _write_boxes(
    agent: str, detected: DetectedBoxes, topic: str, index: int, recording: McapRecording
) -> None:
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


def _write_accidents(
    agent: str, accidents: Sequence[Accident], topic: str, index: int, recording: McapRecording
) -> None:
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
                texts=[
                    label(text, places.mean(axis=0) + np.array([0.0, 0.0, _MARK]), PREDICTED_COLOR)
                ],
            )
        )
        points += [
            colored_points(places, PREDICTED_COLOR),
            segment_points(places[None], PREDICTED_COLOR),
        ]
    recording.write(topic, scene_update(entities, index), index)
    recording.write(f"{topic}/points", cloud_message(joined(points), frame, index), index)


def _sphere(place: Any) -> Any:
    return SpherePrimitive(
        pose=pose(place, np.array([1.0, 0.0, 0.0, 0.0])),
        size=vector(np.full(3, _MARK)),
        color=color_message(PREDICTED_COLOR, 0.8),
    )
