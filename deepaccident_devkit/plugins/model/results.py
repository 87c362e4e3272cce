"""Predictions of samples by a trained model, and results files of them."""

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
    """What a model says of one sample.

    Attributes:
        token: of the sample.
        motion: maps of all draws, the mean last.
        accidents: none, or the one that the maps foresee together.
        boxes: of the present, in the world.
    """

    token: str
    motion: MotionOutput
    accidents: list[Accident]
    boxes: DetectedBoxes


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictConfig:
    """How samples are predicted.

    Attributes:
        agents: who cooperates (`v2x.cooperating_agents`).
        link: what happens to the partners' data; None for nothing. For a budget the payload `bev` is the model's own
            features.
        seed: of the latents' draws, which depend on it and on the sample alone.
        device: where the model is.
        workers: processes that read; 0 for this one.
        images_cache: of `V2XConfig`.
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
    """Predict samples one after another; the result does not depend on the others.

    Args:
        model: in evaluation mode while this runs; on `config.device`.
        dataset: the release.
        tokens: of the samples.
        config: who cooperates, and how.
        progress: whether to show a bar.

    Raises:
        DeepAccidentError: as of `V2XDataset`.
        NotAvailableError: the release lacks what the model sees with.
        WorkerError: a worker process was killed, or cannot send what it has read.
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
    """What the model sees, over a link that knows how large its features are."""
    link, own = config.link, _features(model)[0]
    link = replace(link, payload=own) if link is not None and link.payload == "bev" else link
    return model.config.inputs(config.agents, link=link, images_cache=config.images_cache)


def _features(model: V2XFormer) -> tuple[int, dict[str, Any]]:
    """Bytes of a partner's message, its own map of the present (`V2XFormer.encoded`) and its pose; form of the map."""
    shape, dtype = (
        [model.config.temporal.channels, *model.config.grid.shape],
        next(model.parameters()).dtype,
    )
    return (
        POSE_BYTES + math.prod(shape) * dtype.itemsize,
        {"shape": shape, "dtype": str(dtype).removeprefix("torch.")},
    )


def check_sensor_files(model: ModelConfig, dataset: Dataset, tokens: Sequence[str]) -> None:
    """Raise NotAvailableError, with the remedy, if none of these samples has files of a kind that the model sees."""
    kinds = (
        (model.cameras, CAMERAS, "cameras", "images", "camera folders"),
        (model.pillars, (LIDAR,), "LiDARs", "point clouds", f"{LIDAR} folders"),
    )
    for part, channels, sensors, files, folders in kinds:
        paths = [
            dataset.sensor_path(f"{token}/{channel}") for token in tokens for channel in channels
        ]
        if part is not None and paths and not any(path.exists() for path in paths):
            raise NotAvailableError(
                f"{paths[0]}: the model sees with {sensors}, and this release has no {files} of {tokens[0]}; unpack "
                f"its {folders}, or make a release with them: deepaccident synth OUT --sensors "
                f"{'cameras' if part is model.cameras else 'all'}"
            )


def prediction_of(
    model: V2XFormer, batch: dict[str, Any], config: PredictConfig
) -> SamplePrediction:
    """The prediction of a batch of one item of `training.torch.collate`, by a model in evaluation mode."""
    [token] = batch["token"]
    delay = 0 if config.link is None else config.link.latency_frames
    inputs = model_inputs(batch, model.config.handedness, delay=delay).to(config.device)
    generator = torch.Generator().manual_seed(zlib.crc32(f"{config.seed} {token}".encode()))
    with torch.inference_mode():
        predicted = model(inputs, noise=model.noise(1, generator).to(config.device))
    [found] = decode_detections(predicted.detection, model.config.detection, model.config.decoding)
    motion = motion_output(
        PredictedMotionMaps(*(each[:, 0] for each in predicted.motion.maps)), model
    )
    accident = foreseen_accident(
        motion, step=model.config.labels.step * FRAME_PERIOD, labels=model.config.labels_protocol
    )
    return SamplePrediction(
        token=token,
        motion=motion,
        accidents=[] if accident is None else [accident],
        boxes=detected_boxes(
            replace(found, boxes=mirrored_boxes(found.boxes, model.config.handedness)),
            batch["world_from_ego"][0],
        ),
    )


def motion_output(maps: PredictedMotionMaps, model: V2XFormer) -> MotionOutput:
    """The devkit's form of the maps (K, T, …) of one ego: centres as probabilities, on the labels' grid."""
    given = (
        maps.segmentation,
        maps.instance_center.sigmoid(),
        maps.instance_offset,
        maps.instance_flow,
    )
    return MotionOutput.from_arrays(
        *(each.float().cpu().numpy() for each in given), grid=model.config.labels.grid
    )


def predict_results(
    model: V2XFormer,
    dataset: Dataset,
    tokens: Sequence[str],
    out: str | os.PathLike[str],
    config: PredictConfig | None = None,
    *,
    progress: bool = False,
) -> dict[ResultsTask, Path]:
    """Predict samples, each once for all tasks, and write the results; nothing is left of a call that breaks off.

    Args:
        model: on the configuration's device.
        dataset: the release.
        tokens: of the samples.
        out: the folder to write into.
        config: who cooperates, and how; None for all agents on the CPU.
        progress: whether to show a bar.

    Returns:
        Task → the file or folder written.

    Raises:
        ResultsError: results are there already, or cannot be written.
        DeepAccidentError: as of `predictions`.
    """
    config = config or PredictConfig()
    folder = writable_folder(out)
    paths: dict[ResultsTask, Path] = {
        task: folder / name for task, name in RESULTS_NAMES.items() if task != "planning"
    }
    meta = _meta(model, dataset, tokens, config)
    labels = model.config.labels
    form: dict[str, Any] = {
        "grid": labels.grid,
        "step": labels.step * FRAME_PERIOD,
        "labels": model.config.labels_protocol,
    }
    with worker_faults_named(), ExitStack() as stack:
        writers = {
            task: ResultsWriter(path, task, meta=meta, **(form if task == "motion" else {}))
            for task, path in paths.items()
        }
        for writer in writers.values():
            stack.enter_context(writer)
        for found in predictions(model, dataset, tokens, config, progress=progress):
            writers["motion"].add(found.token, found.motion)
            writers["accident"].add(found.token, found.accidents)
            writers["detection"].add(found.token, found.boxes)
            writers["forecasting"].add(
                found.token, _forecasts(dataset, found, form["step"], form["labels"])
            )
    return paths


def _forecasts(
    dataset: Dataset, found: SamplePrediction, step: float, labels: str
) -> list[Forecast]:
    """Of the actors that labels show at a sample's present; none without labels, which say who is who."""
    scenario, _, number = found.token.rsplit("/", 2)
    boxes = scenario_tracks(dataset, scenario).at(int(number))
    boxes = boxes.transform(dataset.world_from(found.token, "ego").inverse(), "ego")
    return forecasts_of(found.motion, boxes.actor_id, boxes.center[:, :2], step=step, labels=labels)


def scores_text(model: V2XFormer, dataset: Dataset, tokens: Sequence[str], path: Path) -> str:
    """IoU and VPQ of motion results at samples, beside what the notes of shipped weights expect of another release."""
    rules = replace(MOTION_PROTOCOLS["paper"], labels=model.config.labels_protocol)
    evaluator, results = MotionEvaluator(rules, trajectories=False), read_results(path)
    for token, labels in zip(
        tokens, motion_labels_of(dataset, tokens, model.config.labels), strict=True
    ):
        predicted: Any = results.prediction(token)
        evaluator.update(token, predicted, labels)
    here, told = evaluator.compute().ranges["100x100"], model.notes["scored"]
    expected = "IoU {iou:.1%}, VPQ {vpq:.1%}".format_map(told["scores"])
    return (
        f"motion, labels {rules.labels}: IoU {here.iou:.1f}%, VPQ {here.pq:.1f}% within 100 m x 100 m here; "
        f"{expected} on {told['synth']['scenarios']} synthetic scenarios that the training had not seen, with agents "
        f"{told['agents']}"
    )


def _meta(
    model: V2XFormer, dataset: Dataset, tokens: Sequence[str], config: PredictConfig
) -> dict[str, Any]:
    """The notes in the results."""
    return {
        "method": "V2XFormer of the devkit",
        "model": dict(model.notes),
        "agents": agents_note(config.agents),
        "link": None if config.link is None else asdict(config.link),
        "seed": config.seed,
        "release": release_note(dataset, map(scenario_of, tokens)),
        "devkit": __version__,
        "bytes": _sent(model, dataset, tokens, config),
    }


def _sent(
    model: V2XFormer, dataset: Dataset, tokens: Sequence[str], config: PredictConfig
) -> dict[str, Any]:
    """The note on the bytes that partners send; those whose sensor files are not there send none."""
    check_sensor_files(model.config, dataset, tokens[:1])
    size, form = _features(model)
    senders = V2XDataset(dataset, tokens, replace(_inputs(model, config), past=1)).senders()
    sent = [(size * (len(names) - 1), len(names) - 1) for names in senders]
    return traffic_note(sent, config.link, "bev", **form)
