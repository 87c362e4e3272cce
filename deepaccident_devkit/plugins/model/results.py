"""A trained model's predictions for samples, and results files that contain them."""

import math
import zlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import torch
from tqdm.auto import tqdm

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.evaluation import (
    Accident,
    DetectedBoxes,
    MotionEvaluator,
    MotionOutput,
    ResultsWriter,
    foreseen_accident,
    read_results,
)
from deepaccident_devkit.evaluation.forecasting import Forecast, forecasts_of
from deepaccident_devkit.evaluation.motion import MOTION_PROTOCOLS
from deepaccident_devkit.evaluation.results import RESULTS_NAMES, ResultsTask
from deepaccident_devkit.evaluation.runs.setups import release_note, scenario_of
from deepaccident_devkit.motion import motion_labels_of
from deepaccident_devkit.plugins.model.detection import decode_detections, detected_boxes
from deepaccident_devkit.plugins.model.inputs import mirrored_boxes, model_inputs
from deepaccident_devkit.plugins.model.loading import name_worker_faults, read_batches
from deepaccident_devkit.plugins.model.motion import PredictedMotionMaps
from deepaccident_devkit.plugins.model.network import ModelConfig, V2XFormer
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.files import writable_folder
from deepaccident_devkit.support.text import PathType
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import CAMERAS, FRAME_PERIOD, LIDAR
from deepaccident_devkit.training.torch import V2XConfig, V2XDataset, collate
from deepaccident_devkit.v2x import Agents, Link
from deepaccident_devkit.v2x.agents import agents_note
from deepaccident_devkit.v2x.messages import POSE_BYTES, traffic_note
from deepaccident_devkit.v2x.tracks import scenario_tracks

# Tasks for which results are written.
_WRITTEN_TASKS: Sequence[ResultsTask] = ("motion", "accident", "detection", "forecasting")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SamplePrediction(ShortRepr):
    """A model's prediction for one sample.

    Attributes:
        token: Token of the sample.
        motion: Maps of all draws of the latent, and last of its mean.
        accidents: The accident that all maps together predict; None if they predict none.
        boxes: Boxes in the current frame, in world coordinates.
    """

    token: str
    motion: MotionOutput
    accidents: list[Accident]
    boxes: DetectedBoxes


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictConfig:
    """Rules for predicting samples.

    Attributes:
        agents: The cooperating agents (`v2x.cooperating_agents`).
        link: Degradation of the partners' data; None for none. With a budget, the payload `bev`
            stands for the model's features.
        seed: Seed of the latents' draws, which depend only on it and on the sample.
        device: Device of the model.
        workers: Number of processes that read the data; 0 to read in this process.
        images_cache: Cache of images, as in `V2XConfig`.
    """

    agents: Agents = "all"
    link: Link | None = None
    seed: int = 0
    device: str = "cpu"
    workers: int = 0
    images_cache: PathType | None = None


def predictions(
    model: V2XFormer,
    dataset: Dataset,
    tokens: Sequence[str],
    config: PredictConfig,
    *,
    progress: bool = False,
) -> Iterator[SamplePrediction]:
    """Predict samples one after another; a prediction does not depend on other samples.

    Args:
        model: The model on `config.device`; it is in evaluation mode while this runs.
        dataset: The release.
        tokens: Tokens of the samples.
        config: Cooperating agents and other rules.
        progress: Whether to show a progress bar.

    Raises:
        DeepAccidentError: As in `V2XDataset`.
        NotAvailableError: The release lacks the files of the model's sensors.
        WorkerError: A worker process was killed, or cannot send the data that it has read.
    """
    check_sensor_files(model.config, dataset, tokens[:1])
    data = V2XDataset(dataset, tokens, _configure_inputs(model, config))
    training = model.training
    model.eval()
    try:
        with name_worker_faults():
            batches = read_batches(data, collate, config.workers)
            bar = tqdm(
                batches, desc="Predicting", total=len(tokens), unit="sample", disable=not progress
            )
            for batch in bar:
                yield prediction_of(model, batch, config)
    finally:
        model.train(training)


def _configure_inputs(model: V2XFormer, config: PredictConfig) -> V2XConfig:
    """Return the config of the model's inputs; the link gets the size of its features."""
    link = config.link
    if link is not None and link.payload == "bev":
        message_bytes, _ = _measure_message(model)
        link = replace(link, payload=message_bytes)
    return model.config.inputs(config.agents, link=link, images_cache=config.images_cache)


def _measure_message(model: V2XFormer) -> tuple[int, NamedValues]:
    """Return the bytes of a partner's message, and the shape and dtype of its map.

    The message consists of the partner's own map of the present (`V2XFormer.encoded`) and its pose.
    """
    shape = [model.config.temporal.channels, *model.config.grid.shape]
    dtype = next(model.parameters()).dtype
    map_bytes = math.prod(shape) * dtype.itemsize
    map_note = {"shape": shape, "dtype": str(dtype).removeprefix("torch.")}
    return POSE_BYTES + map_bytes, map_note


def check_sensor_files(model: ModelConfig, dataset: Dataset, tokens: Sequence[str]) -> None:
    """Check that the samples have files of the model's sensors.

    Raise NotAvailableError with the remedy if no sample has camera files although the model needs
    them, or none has LiDAR files.
    """
    sensor_kinds = (
        (model.cameras, CAMERAS, "cameras", "images", "camera folders", "cameras"),
        (model.pillars, (LIDAR,), "LiDARs", "point clouds", f"{LIDAR} folders", "clouds"),
    )
    needs_both = model.cameras is not None and model.pillars is not None
    for sensor_config, channels, sensors, files, folders, kind in sensor_kinds:
        if sensor_config is None:
            continue
        paths = []
        for token, channel in product(tokens, channels):
            paths.append(dataset.sensor_path(f"{token}/{channel}"))
        if paths and not any(path.exists() for path in paths):
            raise NotAvailableError(
                f"{paths[0]}: the model needs {sensors}, but this release has no {files} of "
                f"{tokens[0]}; unpack its {folders}, or make a release with them: deepaccident "
                f"synth OUT --sensors {'all' if needs_both else kind}"
            )


def prediction_of(model: V2XFormer, batch: NamedValues, config: PredictConfig) -> SamplePrediction:
    """Predict a batch of one item (`training.torch.collate`) with a model in evaluation mode."""
    [token] = batch["token"]
    model_config = model.config
    delay = 0 if config.link is None else config.link.latency_frames
    inputs = model_inputs(batch, model_config.handedness, delay=delay).to(config.device)
    seed_text = f"{config.seed} {token}"
    generator = torch.Generator().manual_seed(zlib.crc32(seed_text.encode()))
    with torch.inference_mode():
        noise = model.noise(1, generator).to(config.device)
        outputs = model(inputs, noise=noise)
    [detections] = decode_detections(
        outputs.detection, model_config.detection, model_config.decoding
    )
    ego_maps = [tensor[:, 0] for tensor in outputs.motion.maps]
    motion = motion_output(PredictedMotionMaps(*ego_maps), model)
    accident = foreseen_accident(
        motion, step=model_config.labels.step * FRAME_PERIOD, labels=model_config.labels_protocol
    )
    mirrored = mirrored_boxes(detections.boxes, model_config.handedness)
    boxes = detected_boxes(replace(detections, boxes=mirrored), batch["world_from_ego"][0])
    accidents = [] if accident is None else [accident]
    return SamplePrediction(token=token, motion=motion, accidents=accidents, boxes=boxes)


def motion_output(maps: PredictedMotionMaps, model: V2XFormer) -> MotionOutput:
    """Convert one ego's maps (K, T, …) to the devkit's `MotionOutput`.

    Centre logits become probabilities, and the grid is the labels'.
    """
    tensors = (
        maps.segmentation,
        maps.instance_center.sigmoid(),
        maps.instance_offset,
        maps.instance_flow,
    )
    arrays = [tensor.float().cpu().numpy() for tensor in tensors]
    return MotionOutput.from_arrays(*arrays, grid=model.config.labels.grid)


def predict_results(
    model: V2XFormer,
    dataset: Dataset,
    tokens: Sequence[str],
    out: PathType,
    config: PredictConfig | None = None,
    *,
    progress: bool = False,
) -> dict[ResultsTask, Path]:
    """Predict samples, each of them once for all tasks, and write the results.

    An interrupted call leaves nothing behind.

    Args:
        model: The model, on the configuration's device.
        dataset: The release.
        tokens: Tokens of the samples.
        out: The folder to write into.
        config: Cooperating agents and other rules; None for all agents on the CPU.
        progress: Whether to show a progress bar.

    Returns:
        Task → the written file or folder.

    Raises:
        ResultsError: Results exist already, or cannot be written.
        DeepAccidentError: As in `predictions`.
    """
    config = config or PredictConfig()
    folder = writable_folder(out)
    paths: dict[ResultsTask, Path] = {}
    for task in _WRITTEN_TASKS:
        paths[task] = folder / RESULTS_NAMES[task]
    meta = _make_notes(model, dataset, tokens, config)
    labels = model.config.labels
    step = labels.step * FRAME_PERIOD
    protocol: Any = model.config.labels_protocol
    motion_options = {"grid": labels.grid, "step": step, "labels": protocol}
    with name_worker_faults(), ExitStack() as stack:
        writers = {}
        for task, path in paths.items():
            options = motion_options if task == "motion" else {}
            writers[task] = ResultsWriter(path, task, meta=meta, **options)
        for writer in writers.values():
            stack.enter_context(writer)
        for prediction in predictions(model, dataset, tokens, config, progress=progress):
            token = prediction.token
            writers["motion"].add(token, prediction.motion)
            writers["accident"].add(token, prediction.accidents)
            writers["detection"].add(token, prediction.boxes)
            forecasts = _forecast_actors(dataset, prediction, step, protocol)
            writers["forecasting"].add(token, forecasts)
    return paths


def _forecast_actors(
    dataset: Dataset, prediction: SamplePrediction, step: float, labels: str
) -> list[Forecast]:
    """Return forecasts for the actors that are labelled in a sample's current frame.

    Empty if the sample has no labels, since labels identify the actors.
    """
    token = prediction.token
    scenario, _, frame = token.rsplit("/", 2)
    world_boxes = scenario_tracks(dataset, scenario).at(int(frame))
    ego_from_world = dataset.world_from(token, "ego").inverse()
    boxes = world_boxes.transform(ego_from_world, "ego")
    centers = boxes.center[:, :2]
    return forecasts_of(prediction.motion, boxes.actor_id, centers, step=step, labels=labels)


def scores_text(model: V2XFormer, dataset: Dataset, tokens: Sequence[str], path: Path) -> str:
    """Return text with the motion results' IoU and VPQ, and the scores in the model's notes.

    The notes of the shipped weights contain scores on another release.
    """
    protocol = replace(MOTION_PROTOCOLS["paper"], labels=model.config.labels_protocol)
    evaluator = MotionEvaluator(protocol, trajectories=False)
    results = read_results(path)
    all_labels = motion_labels_of(dataset, tokens, model.config.labels)
    for token, labels in zip(tokens, all_labels, strict=True):
        prediction: Any = results.prediction(token)
        evaluator.update(token, prediction, labels)
    scores = evaluator.compute().ranges["100x100"]
    notes = model.notes["scored"]
    expected = "IoU {iou:.1%}, VPQ {vpq:.1%}".format_map(notes["scores"])
    return (
        f"motion, labels {protocol.labels}: IoU {scores.iou:.1f}%, VPQ {scores.pq:.1f}% within "
        f"100 m x 100 m on these samples; {expected} on {notes['synth']['scenarios']} synthetic "
        f"scenarios outside the training, with agents {notes['agents']}"
    )


def _make_notes(
    model: V2XFormer, dataset: Dataset, tokens: Sequence[str], config: PredictConfig
) -> NamedValues:
    """Return the notes that the results contain."""
    link_note = None if config.link is None else asdict(config.link)
    return {
        "method": "V2XFormer of the devkit",
        "model": dict(model.notes),
        "agents": agents_note(config.agents),
        "link": link_note,
        "seed": config.seed,
        "release": release_note(dataset, map(scenario_of, tokens)),
        "devkit": __version__,
        "bytes": _note_sent_bytes(model, dataset, tokens, config),
    }


def _note_sent_bytes(
    model: V2XFormer, dataset: Dataset, tokens: Sequence[str], config: PredictConfig
) -> NamedValues:
    """Note how many bytes partners send; a partner without sensor files sends none."""
    check_sensor_files(model.config, dataset, tokens[:1])
    message_bytes, map_note = _measure_message(model)
    present_inputs = replace(_configure_inputs(model, config), past=1)
    sent = []
    for agents in V2XDataset(dataset, tokens, present_inputs).senders():
        num_partners = len(agents) - 1
        sent.append((message_bytes * num_partners, num_partners))
    return traffic_note(sent, config.link, "bev", **map_note)
