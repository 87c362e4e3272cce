"""The predictions of a row: by a model, also with spoilt inputs, by a baseline, or trivial ones."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.evaluation import Accident, DetectedBoxes, MotionOutput, foreseen_accident
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.runs.setups import scenario_of
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabelConfig, motion_labels
from deepaccident_devkit.plugins.baselines import (
    detected_accidents,
    predict_accidents,
    predict_detections,
    predict_motion,
)
from deepaccident_devkit.plugins.baselines.outlook import MotionModel
from deepaccident_devkit.plugins.study.recipe import StudyRow
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x.cooperation import visible_actors

if TYPE_CHECKING:
    from deepaccident_devkit.plugins.model import PredictConfig, V2XFormer
    from deepaccident_devkit.plugins.model.results import SamplePrediction

# The parts of an item of `V2XDataset` that are not per agent; all other parts are indexed by agent.
_SHARED_PARTS: Final = (
    "token",
    "agents",
    "agent_valid",
    "world_from_ego",
    "augmentation",
    "files_missing",
)
# The outputs of a sample: motion, accidents, and boxes in the world frame.
Prediction = tuple[MotionOutput, list[Accident], DetectedBoxes]


def predictions_of(
    row: StudyRow,
    weights: Path | None,
    device: str,
    dataset: Dataset,
    tokens: Sequence[str],
    labels: MotionLabelConfig,
) -> Iterator[tuple[str, Prediction]]:
    """Yield samples' tokens and predictions, one after another.

    Args:
        row: The row of the recipe.
        weights: Weights of a model; None without a model.
        device: Device of the model.
        dataset: The release.
        tokens: Tokens of the samples.
        labels: Config of the motion labels that are predicted.

    Raises:
        ConfigError: The weights were trained for other labels, or latency is longer than a sample's
            past.
        NotAvailableError: There is no other pair of scenarios to take partners from.
        DeepAccidentError: As in `model.predictions`, or the baselines.
    """
    if weights is not None:
        yield from _model_predictions(row, weights, device, dataset, tokens, labels)
        return
    for token in tokens:
        yield token, _prediction_without_model(row, dataset, token, labels)


def _prediction_without_model(
    row: StudyRow, dataset: Dataset, token: str, labels: MotionLabelConfig
) -> Prediction:
    """Return the prediction of a baseline or a trivial row."""
    if row.baseline is not None:
        return _baseline_prediction(row, row.baseline, dataset, token, labels)
    if row.trivial == "labels":
        return _label_prediction(row, dataset, token, labels)
    fill_value = row.trivial == "everything"
    maps = np.full((1, labels.label_frames, *labels.grid.shape), fill_value, dtype=np.int32)
    motion = MotionOutput(grid=labels.grid, instances=maps)
    no_boxes = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [], frame="world")
    return motion, [], DetectedBoxes(boxes=no_boxes, scores=np.zeros(0))


def _baseline_prediction(
    row: StudyRow,
    motion_model: MotionModel,
    dataset: Dataset,
    token: str,
    labels: MotionLabelConfig,
) -> Prediction:
    """Return the extrapolation of the actors that the cooperating agents see."""
    cooperation = dict[str, Any](agents=row.cooperating, link=row.link)
    motion = predict_motion(dataset, token, model=motion_model, config=labels, **cooperation)
    horizon = labels.future_frames * (labels.step * FRAME_PERIOD)
    accidents = predict_accidents(
        dataset, token, model=motion_model, horizon=horizon, **cooperation
    )
    return motion, accidents, predict_detections(dataset, token, **cooperation)


def _label_prediction(
    row: StudyRow, dataset: Dataset, token: str, labels: MotionLabelConfig
) -> Prediction:
    """Return the labels of the actors that the agents see at the present."""
    cooperation = dict[str, Any](agents=row.cooperating, link=row.link)
    agent_labels = replace(labels, agents=row.cooperating)
    truth = motion_labels(dataset, token, agent_labels).to_present()
    visible_ids = {OWN_BOX_ID, *visible_actors(dataset, token, **cooperation).tolist()}
    # Actors that only come into sight later are left out.
    visible_numbers = [number for actor, number in truth.id_map.items() if actor in visible_ids]
    instances = np.where(np.isin(truth.instance, visible_numbers), truth.instance, 0)
    motion = MotionOutput(grid=labels.grid, instances=instances[None])
    step = labels.step * FRAME_PERIOD
    accident = foreseen_accident(motion, step=step, labels=str(labels.protocol))
    accidents = [] if accident is None else [accident]
    return motion, accidents, predict_detections(dataset, token, **cooperation)


def _model_predictions(
    row: StudyRow,
    weights: Path,
    device: str,
    dataset: Dataset,
    tokens: Sequence[str],
    labels: MotionLabelConfig,
) -> Iterator[tuple[str, Prediction]]:
    """Yield samples' tokens and predictions by a model."""
    from deepaccident_devkit.plugins.model import PredictConfig, load_model, predictions
    from deepaccident_devkit.plugins.model.training_run import one_thread

    model = load_model(weights).to(device).eval()
    trained_labels = model.config.labels_protocol
    if trained_labels != labels.protocol:
        raise ConfigError(
            f"{weights}: was trained with the labels {trained_labels}; give "
            f"`labels: {trained_labels}` in the recipe's `test`"
        )
    config = PredictConfig(agents=row.cooperating, link=row.link, device=device)
    if row.control is None:
        outputs = predictions(model, dataset, tokens, config)
    else:
        outputs = _spoilt_predictions(row, model, dataset, tokens, config)
    with one_thread():
        for output in outputs:
            accidents = output.accidents
            if row.baseline is not None:
                accidents = detected_accidents(
                    dataset, output.token, output.boxes, horizon=model.config.horizon
                )
            yield output.token, (output.motion, accidents, output.boxes)


def _spoilt_predictions(
    row: StudyRow,
    model: V2XFormer,
    dataset: Dataset,
    tokens: Sequence[str],
    config: PredictConfig,
) -> Iterator[SamplePrediction]:
    """Return the model's predictions from inputs that are spoilt by the row's control."""
    from deepaccident_devkit.plugins.model.results import prediction_of
    from deepaccident_devkit.training.torch import V2XDataset, collate

    inputs = model.config.inputs(config.agents, link=config.link)
    items: Any = V2XDataset(dataset, tokens, inputs)
    spoilt_items: Iterator[dict[str, Any]]
    if row.control == "strangers":
        stranger_items: Any = V2XDataset(dataset, strangers_of(tokens), inputs)
        spoilt_items = (
            with_strangers(items[index], stranger_items[index]) for index in range(len(items))
        )
    else:
        spoilt_items = (blanked(items[index]) for index in range(len(items)))
    return (prediction_of(model, collate([item]), config) for item in spoilt_items)


def strangers_of(tokens: Sequence[str]) -> list[str]:
    """Return a sample of another pair of scenarios for each sample; partners are taken from it.

    It has the same rank among the samples of its scenario. Raises NotAvailableError: all samples
    are of one pair.
    """
    tokens_by_scenario: dict[str, list[str]] = {}
    for token in tokens:
        tokens_by_scenario.setdefault(scenario_of(token), []).append(token)
    scenarios = list(tokens_by_scenario)
    strangers = []
    for index, scenario in enumerate(scenarios):
        candidates = scenarios[index:] + scenarios[:index]
        other = next(
            (name for name in candidates if cluster_of(name) != cluster_of(scenario)), None
        )
        if other is None:
            raise NotAvailableError(
                f"{scenario}: there is no other pair to take strangers from; test on several pairs"
            )
        other_tokens = tokens_by_scenario[other]
        for rank in range(len(tokens_by_scenario[scenario])):
            strangers.append(other_tokens[min(rank, len(other_tokens) - 1)])
    return strangers


def blanked(item: Mapping[str, Any]) -> dict[str, Any]:
    """Return an item of `V2XDataset` with black images and clouds without points."""
    blank = dict(item)
    if "images" in item:
        blank["images"] = item["images"] * 0
    if "points" in item:
        blank["points"] = [[cloud[:0] for cloud in clouds] for clouds in item["points"]]
    return blank


def with_strangers(item: Mapping[str, Any], stranger: Mapping[str, Any]) -> dict[str, Any]:
    """Return an item with partners' sensors and poses from another item's agents of these names."""
    changed = {}
    for name, value in item.items():
        if name not in _SHARED_PARTS:
            changed[name] = copy(value) if isinstance(value, list) else value.clone()
    for slot, name in enumerate(item["agents"]):
        if slot and name in stranger["agents"]:
            stranger_slot = stranger["agents"].index(name)
            for key, values in changed.items():
                values[slot] = stranger[key][stranger_slot]
    return {**item, **changed}
