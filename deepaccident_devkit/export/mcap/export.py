"""A scenario's messages, moment by moment."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from tqdm import tqdm

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.export.mcap.actors import Actors
from deepaccident_devkit.export.mcap.cells import MotionMaps
from deepaccident_devkit.export.mcap.config import EXPORTED_CHANNELS, McapConfig, Predictions
from deepaccident_devkit.export.mcap.facts import METADATA, Story, scenario_metadata
from deepaccident_devkit.export.mcap.messages import frame_id, transform_message
from deepaccident_devkit.export.mcap.moment import Moment, exported_agents, moment_of
from deepaccident_devkit.export.mcap.predicted import PredictedScenes
from deepaccident_devkit.export.mcap.recording import Recording, frame_timestamp
from deepaccident_devkit.export.mcap.sensors import Sensors
from deepaccident_devkit.files import replacing
from deepaccident_devkit.motion.config import label_config


class _Part(Protocol):
    """Writes one kind of content."""

    def write(self, moment: Moment, recording: Recording) -> None:
        """Write this content of a moment."""
        ...


class Poses:
    """Writes where the agents and their sensors are."""

    def __init__(self, dataset: Dataset) -> None:
        """Prepare the poses of a release."""
        self._dataset = dataset

    def write(self, moment: Moment, recording: Recording) -> None:
        """Write world → agent → sensors in one message, and each agent's pose in a message of its own."""
        transforms, poses = [], []
        for agent, sample in moment.samples.items():
            own = frame_id(agent, "ego")
            there = transform_message("world", own, self._dataset.world_from(sample, "ego"), moment.index)
            transforms.append(there)
            transforms += [
                transform_message(own, frame_id(agent, channel), self._dataset.ego_from(sample, channel), moment.index)
                for channel in EXPORTED_CHANNELS
            ]
            poses.append((agent, there))
        recording.write("/tf", FrameTransforms(transforms=transforms), moment.index)
        for agent, there in poses:
            message = PoseInFrame(timestamp=frame_timestamp(moment.index), frame_id="world")
            message.pose.position.CopyFrom(there.translation)
            message.pose.orientation.CopyFrom(there.rotation)
            recording.write(f"/{agent}/pose", message, moment.index)


def write_scenario(
    dataset: Dataset,
    scenario: RowArgument,
    path: Path,
    config: McapConfig,
    *,
    prediction: Predictions | None,
    progress: bool,
) -> Path:
    """The work of `export_mcap`, with the same arguments and errors."""
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    token = record["token"]
    agents = exported_agents(dataset, token, config.agents)
    moments = [moment_of(token, index, agents) for index in config.frame_numbers(record["num_frames"])]
    sensors = Sensors(dataset, config)
    parts: list[_Part] = [Story(dataset, token), Poses(dataset), sensors]
    if config.labels:
        parts.append(Actors(dataset, token))
    if config.motion_labels is not None:
        parts.append(MotionMaps(dataset, token, label_config(config.motion_labels)))
    if prediction is not None:
        parts.append(_predicted(prediction, moments, token))
    with replacing(path) as temporary, temporary.open("wb") as stream, Recording(stream) as recording:
        recording.add_metadata(METADATA, scenario_metadata(dataset, token))
        for moment in tqdm(moments, desc=path.name, disable=not progress, unit="frame"):
            for part in parts:
                part.write(moment, recording)
    sensors.tell_missing()
    return path


def _predicted(prediction: Predictions, moments: list[Moment], scenario: str) -> PredictedScenes:
    scenes = PredictedScenes(prediction)
    if not any(scenes.has(sample) for moment in moments for sample in moment.samples.values()):
        raise NotAvailableError(
            f"prediction: has nothing of {scenario} at these agents and frames, such as {moments[0].first_sample!r}"
        )
    return scenes
