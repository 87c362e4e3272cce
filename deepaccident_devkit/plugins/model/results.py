"""Predictions of samples by a trained model, and results files with them."""

from __future__ import annotations

import math
import os
import zlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
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
from deepaccident_devkit.plugins.model.loading import read_batches, worker_faults_named
from deepaccident_devkit.plugins.model.motion import PredictedMotionMaps
from deepaccident_devkit.plugins.model.network import ModelConfig, V2XFormer
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.files import writable_folder
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import CAMERAS, FRAME_PERIOD, LIDAR
from deepaccident_devkit.training.torch import V2XConfig, V2XDataset, collate
from deepaccident_devkit.v2x import Agents, Link
from deepaccident_devkit.v2x.agents import agents_note
from deepaccident_devkit.v2x.messages import POSE_BYTES, traffic_note
from deepaccident_devkit.v2x.tracks import scenario_tracks


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SamplePrediction(ShortRepr):
    """A model's prediction of one sample.

    Attributes:
        token: Token of the sample.
        motion: Maps of all draws, the mean last.
        accidents: The accident that all maps together foresee, if any.
        boxes: Boxes at the present, in the world frame.
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
        link: Degradation of the partners' data; None for none. With a budget the payload `bev` is
            the model's own features.
        seed: Seed of the latents' draws, which only depend on it and on the sample.
        device: Device of the model.
        workers: Number of processes that read; 0 for this process.
        images_cache: Cache of images, as in `V2XConfig`.
    """

    agents: Agents = "all"
    link: Link | None = None
    seed: int = 0
    device: str = "cpu"
    workers: int = 0
    images_cache: str | os.PathLike[str] | None = None


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
        NotAvailableError: The release lacks the sensors of the model.
        WorkerError: A worker process was killed, or cannot send the data that it has read.
    """
    check_sensor_files(model.config, dataset, tokens[:1])
    data = V2XDataset(dataset, tokens, _inputs(model, config))
    training = model.training
    model.eval()
    try:
        with worker_faults_named():
            batches = read_batches(data, collate, config.workers)
            for batch in tqdm(
                batches, desc="predicting", total=len(tokens), unit="sample", disable=not progress
            ):
                yield prediction_of(model, batch, config)
    finally:
        model.train(training)


def _inputs(model: V2XFormer, config: PredictConfig) -> V2XConfig:
    """Return the config of the model's inputs, with the size of its features in the link."""
    link = config.link
    message_bytes = _message_size(model)[0]
    if link is not None and link.payload == "bev":
        link = replace(link, payload=message_bytes)
    return model.config.inputs(config.agents, link=link, images_cache=config.images_cache)


def _message_size(model: V2XFormer) -> tuple[int, dict[str, Any]]:
    """Return the bytes of a partner's message, and the shape and dtype of its map.

    The message has its own map of the present (`V2XFormer.encoded`) and its pose.
    """
    shape = [model.config.temporal.channels, *model.config.grid.shape]
    dtype = next(model.parameters()).dtype
    form = {"shape": shape, "dtype": str(dtype).removeprefix("torch.")}
    return POSE_BYTES + math.prod(shape) * dtype.itemsize, form


def check_sensor_files(model: ModelConfig, dataset: Dataset, tokens: Sequence[str]) -> None:
    """Raise NotAvailableError, with the remedy, if the samples lack files of the model's sensors.

    It is raised if no sample has a file of one of the sensors.
    """
    kinds = (
        (model.cameras, CAMERAS, "cameras", "images", "camera folders"),
        (model.pillars, (LIDAR,), "LiDARs", "point clouds", f"{LIDAR} folders"),
    )
    for part, channels, sensors, files, folders in kinds:
        paths = [
            dataset.sensor_path(f"{token}/{channel}") for token in tokens for channel in channels
        ]
        if part is not None and paths and not any(path.exists() for path in paths):
            option = "cameras" if part is model.cameras else "all"
            raise NotAvailableError(
                f"{paths[0]}: the model sees with {sensors}, and this release has no {files} of "
                f"{tokens[0]}; unpack its {folders}, or make a release with them: deepaccident "
                f"synth OUT --sensors {option}"
            )


def prediction_of(
    model: V2XFormer, batch: dict[str, Any], config: PredictConfig
) -> SamplePrediction:
    """Predict a batch of one item of `training.torch.collate`, by a model in evaluation mode."""
    [token] = batch["token"]
    model_config = model.config
    delay = 0 if config.link is None else config.link.latency_frames
    inputs = model_inputs(batch, model_config.handedness, delay=delay).to(config.device)
    generator = torch.Generator().manual_seed(zlib.crc32(f"{config.seed} {token}".encode()))
    with torch.inference_mode():
        outputs = model(inputs, noise=model.noise(1, generator).to(config.device))
    [detections] = decode_detections(
        outputs.detection, model_config.detection, model_config.decoding
    )
    maps = PredictedMotionMaps(*(tensor[:, 0] for tensor in outputs.motion.maps))
    motion = motion_output(maps, model)
    accident = foreseen_accident(
        motion, step=model_config.labels.step * FRAME_PERIOD, labels=model_config.labels_protocol
    )
    boxes = mirrored_boxes(detections.boxes, model_config.handedness)
    world_from_ego = batch["world_from_ego"][0]
    return SamplePrediction(
        token=token,
        motion=motion,
        accidents=[] if accident is None else [accident],
        boxes=detected_boxes(replace(detections, boxes=boxes), world_from_ego),
    )


def motion_output(maps: PredictedMotionMaps, model: V2XFormer) -> MotionOutput:
    """Return the devkit's form of the maps (K, T, …) of one ego.

    Centres become probabilities, and the grid is that of the labels.
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
    out: str | os.PathLike[str],
    config: PredictConfig | None = None,
    *,
    progress: bool = False,
) -> dict[ResultsTask, Path]:
    """Predict samples, each once for all tasks, and write the results.

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
    paths: dict[ResultsTask, Path] = {
        task: folder / name for task, name in RESULTS_NAMES.items() if task != "planning"
    }
    meta = _meta(model, dataset, tokens, config)
    labels = model.config.labels
    motion_options: dict[str, Any] = {
        "grid": labels.grid,
        "step": labels.step * FRAME_PERIOD,
        "labels": model.config.labels_protocol,
    }
    step, protocol = motion_options["step"], motion_options["labels"]
    with worker_faults_named(), ExitStack() as stack:
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
            writers["forecasting"].add(token, _forecasts(dataset, prediction, step, protocol))
    return paths


def _forecasts(
    dataset: Dataset, prediction: SamplePrediction, step: float, labels: str
) -> list[Forecast]:
    """Return forecasts of the actors that labels show at a sample's present.

    Without labels, which identify the actors, there are none.
    """
    token = prediction.token
    scenario, _, number = token.rsplit("/", 2)
    boxes = scenario_tracks(dataset, scenario).at(int(number))
    boxes = boxes.transform(dataset.world_from(token, "ego").inverse(), "ego")
    centers = boxes.center[:, :2]
    return forecasts_of(prediction.motion, boxes.actor_id, centers, step=step, labels=labels)


def scores_text(model: V2XFormer, dataset: Dataset, tokens: Sequence[str], path: Path) -> str:
    """Return the IoU and VPQ of motion results at samples, and the scores in the weights' notes.

    The notes of shipped weights have scores on another release.
    """
    protocol = replace(MOTION_PROTOCOLS["paper"], labels=model.config.labels_protocol)
    evaluator, results = MotionEvaluator(protocol, trajectories=False), read_results(path)
    all_labels = motion_labels_of(dataset, tokens, model.config.labels)
    for token, labels in zip(tokens, all_labels, strict=True):
        prediction: Any = results.prediction(token)
        evaluator.update(token, prediction, labels)
    scores, notes = evaluator.compute().ranges["100x100"], model.notes["scored"]
    expected = "IoU {iou:.1%}, VPQ {vpq:.1%}".format_map(notes["scores"])
    return (
        f"motion, labels {protocol.labels}: IoU {scores.iou:.1f}%, VPQ {scores.pq:.1f}% within "
        f"100 m x 100 m here; {expected} on {notes['synth']['scenarios']} synthetic scenarios that "
        f"the training had not seen, with agents {notes['agents']}"
    )


def _meta(
    model: V2XFormer, dataset: Dataset, tokens: Sequence[str], config: PredictConfig
) -> dict[str, Any]:
    """Return the notes in the results."""
    return {
        "method": "V2XFormer of the devkit",
        "model": dict(model.notes),
        "agents": agents_note(config.agents),
        "link": None if config.link is None else asdict(config.link),
        "seed": config.seed,
        "release": release_note(dataset, map(scenario_of, tokens)),
        "devkit": __version__,
        "bytes": _sent_bytes_note(model, dataset, tokens, config),
    }


def _sent_bytes_note(
    model: V2XFormer, dataset: Dataset, tokens: Sequence[str], config: PredictConfig
) -> dict[str, Any]:
    """Return the note on the bytes that partners send; partners without sensor files send none."""
    check_sensor_files(model.config, dataset, tokens[:1])
    message_bytes, form = _message_size(model)
    senders = V2XDataset(dataset, tokens, replace(_inputs(model, config), past=1)).senders()
    sent = [(message_bytes * (len(names) - 1), len(names) - 1) for names in senders]
    return traffic_note(sent, config.link, "bev", **form)
