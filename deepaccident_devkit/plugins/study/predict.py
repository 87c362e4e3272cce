"""Predictions of a row: a model's (also with degraded inputs), a baseline's, or trivial ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x.cooperation import visible_actors

if TYPE_CHECKING:
    from deepaccident_devkit.plugins.model import PredictConfig, V2XFormer
    from deepaccident_devkit.plugins.model.results import SamplePrediction

# The parts of a `V2XDataset` item that all agents share; other parts are indexed by agent.
_SHARED_PARTS = (
    "token",
    "agents",
    "agent_valid",
    "world_from_ego",
    "augmentation",
    "files_missing",
)
# The outputs for a sample: motion, accidents, and boxes in the world frame.
Prediction = tuple[MotionOutput, list[Accident], DetectedBoxes]


def predictions_of(
    row: StudyRow,
    weights: Path | None,
    device: str,
    dataset: Dataset,
    tokens: Sequence[str],
    labels: MotionLabelConfig,
) -> Iterator[tuple[str, Prediction]]:
    """Yield the token and the prediction of each sample.

    Args:
        row: The row of the recipe.
        weights: Weights of the model; None if the row has no model.
        device: Device on which the model runs.
        dataset: The release.
        tokens: Tokens of the samples.
        labels: Config of the motion labels to predict.

    Raises:
        ConfigError: If the weights were trained for other labels, or the latency exceeds a sample's
            past.
        NotAvailableError: If there is no other pair of scenarios to take partners from.
        DeepAccidentError: For the reasons in `model.predictions`, or in the baselines.
    """
    if weights is None:
        for token in tokens:
            yield token, _prediction_without_model(row, dataset, token, labels)
        return
    from deepaccident_devkit.plugins.model import PredictConfig, load_model, predictions
    from deepaccident_devkit.plugins.model.training_run import one_thread

    model = load_model(weights).to(device).eval()
    trained_labels = model.config.labels_protocol
    if trained_labels != labels.protocol:
        raise ConfigError(
            f"{weights}: was trained with the labels {trained_labels}; set "
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


def _prediction_without_model(
    row: StudyRow, dataset: Dataset, token: str, labels: MotionLabelConfig
) -> Prediction:
    """Return the prediction of a row with a baseline or trivial predictions."""
    if row.baseline is not None:
        return _baseline_prediction(row, row.baseline, dataset, token, labels)
    if row.trivial == "labels":
        return _label_prediction(row, dataset, token, labels)
    fill_value = row.trivial == "everything"
    shape = (1, labels.label_frames, *labels.grid.shape)
    maps = np.full(shape, fill_value, dtype=np.int32)
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
    """Extrapolate the motion of the actors that the cooperating agents see."""
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
    """Return the labels of the actors that the agents see at t = 0, including their future."""
    cooperation = dict[str, Any](agents=row.cooperating, link=row.link)
    agent_labels = replace(labels, agents=row.cooperating)
    truth = motion_labels(dataset, token, agent_labels).to_present()
    visible_ids = {OWN_BOX_ID, *visible_actors(dataset, token, **cooperation).tolist()}
    # Actors that only come into sight later are removed.
    visible_numbers = [number for actor, number in truth.id_map.items() if actor in visible_ids]
    instances = np.where(np.isin(truth.instance, visible_numbers), truth.instance, 0)
    motion = MotionOutput(grid=labels.grid, instances=instances[None])
    step = labels.step * FRAME_PERIOD
    accident = foreseen_accident(motion, step=step, labels=str(labels.protocol))
    accidents = []
    if accident is not None:
        accidents.append(accident)
    return motion, accidents, predict_detections(dataset, token, **cooperation)


def _spoilt_predictions(
    row: StudyRow,
    model: V2XFormer,
    dataset: Dataset,
    tokens: Sequence[str],
    config: PredictConfig,
) -> Iterator[SamplePrediction]:
    """Yield the model's predictions from inputs degraded by the row's `control`."""
    from deepaccident_devkit.plugins.model.results import prediction_of
    from deepaccident_devkit.training.torch import V2XDataset, collate

    inputs = model.config.inputs(config.agents, link=config.link)
    items: Any = V2XDataset(dataset, tokens, inputs)
    stranger_items: Any = None
    if row.control == "strangers":
        stranger_items = V2XDataset(dataset, strangers_of(tokens), inputs)
    for index in range(len(items)):
        if stranger_items is None:
            spoilt_item = blanked(items[index])
        else:
            spoilt_item = with_strangers(items[index], stranger_items[index])
        yield prediction_of(model, collate([spoilt_item]), config)


def strangers_of(tokens: Sequence[str]) -> list[str]:
    """Return, for each sample, a sample of another pair of scenarios to take partners from.

    It has the same rank among its scenario's samples. Raise NotAvailableError if all samples belong
    to one pair.
    """
    tokens_by_scenario: dict[str, list[str]] = {}
    for token in tokens:
        tokens_by_scenario.setdefault(scenario_of(token), []).append(token)
    scenarios = list(tokens_by_scenario)
    strangers = []
    for index, scenario in enumerate(scenarios):
        following = scenarios[index:] + scenarios[:index]
        other_scenarios = [name for name in following if cluster_of(name) != cluster_of(scenario)]
        if not other_scenarios:
            raise NotAvailableError(
                f"{scenario}: there is no other pair to take unrelated partners from; "
                "test several pairs"
            )
        other_tokens = tokens_by_scenario[other_scenarios[0]]
        last_rank = len(other_tokens) - 1
        for rank in range(len(tokens_by_scenario[scenario])):
            strangers.append(other_tokens[min(rank, last_rank)])
    return strangers


def blanked(item: ReadOnlyValues) -> NamedValues:
    """Return an item of `V2XDataset` with black images and empty point clouds."""
    blank = dict(item)
    if "images" in item:
        blank["images"] = item["images"] * 0
    if "points" in item:
        blank["points"] = [[cloud[:0] for cloud in clouds] for clouds in item["points"]]
    return blank


def with_strangers(item: ReadOnlyValues, stranger: ReadOnlyValues) -> NamedValues:
    """Return an item whose partners' sensors and poses come from the same agents in another."""
    changed = {}
    for name, value in item.items():
        if name in _SHARED_PARTS:
            continue
        changed[name] = copy(value) if isinstance(value, list) else value.clone()
    for slot, name in enumerate(item["agents"]):
        if slot and name in stranger["agents"]:
            stranger_slot = stranger["agents"].index(name)
            for key, values in changed.items():
                values[slot] = stranger[key][stranger_slot]
    return {**item, **changed}
