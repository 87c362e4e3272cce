"""Predictions of samples are independent of each other, and fit the devkit's results."""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import torch
from scipy.special import logit
from support.expected_errors import assert_raises
from torch_extra.items import load_item
from torch_extra.model.perfect import perfect_maps
from torch_extra.model.small_model import (
    small_both_config,
    small_config,
    small_lidar_config,
    small_released_config,
)

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.evaluation import (
    MotionEvaluator,
    ResultsWriter,
    read_results,
)
from deepaccident_devkit.evaluation.motion import MOTION_PROTOCOLS
from deepaccident_devkit.motion import MotionHeads, motion_labels
from deepaccident_devkit.plugins.model.detection import detection_targets
from deepaccident_devkit.plugins.model.inputs import mirrored_boxes
from deepaccident_devkit.plugins.model.motion import PredictedMotionMaps
from deepaccident_devkit.plugins.model.network import ModelConfig, V2XFormer
from deepaccident_devkit.plugins.model.results import (
    PredictConfig,
    SamplePrediction,
    predict_results,
    predictions,
)
from deepaccident_devkit.v2x import Link

MakeModel = Callable[..., V2XFormer]
DEFAULT_CONFIG = PredictConfig()


def predict(
    model: V2XFormer, da: DeepAccident, tokens: list[str], config: PredictConfig = DEFAULT_CONFIG
) -> list[SamplePrediction]:
    return list(predictions(model, da, tokens, config))


def iterate_arrays(prediction: SamplePrediction) -> Iterator[np.ndarray]:
    for heads in prediction.motion.heads or ():
        yield from (heads.segmentation, heads.centerness, heads.offset, heads.flow)
    boxes = prediction.boxes.boxes
    yield from (boxes.center, boxes.size, boxes.yaw, boxes.velocity, prediction.boxes.scores)
    for accident in prediction.accidents:
        yield accident.positions
        yield np.array([accident.time, accident.score])


def are_equal(first: SamplePrediction, second: SamplePrediction) -> bool:
    pairs = list(zip(iterate_arrays(first), iterate_arrays(second), strict=True))
    return first.token == second.token and all(
        np.array_equal(values, expected, equal_nan=True) for values, expected in pairs
    )


@pytest.fixture(scope="module")
def model(make_model: MakeModel) -> V2XFormer:
    return make_model(small_config())


@pytest.fixture(scope="module")
def tokens(moment: list[str]) -> list[str]:
    return [moment[0], moment[4], moment[2].replace("/004", "/005")]


@pytest.fixture(scope="module")
def predicted(model: V2XFormer, da: DeepAccident, tokens: list[str]) -> list[SamplePrediction]:
    return predict(model, da, tokens)


def test_a_prediction_does_not_depend_on_others(
    model: V2XFormer, da: DeepAccident, tokens: list[str], predicted: list[SamplePrediction]
) -> None:
    """The state of torch's own generator does not matter either."""
    assert [prediction.token for prediction in predicted] == tokens

    torch.manual_seed(99)
    reversed_order = predict(model, da, tokens[::-1])
    for prediction, other in zip(predicted, reversed_order[::-1], strict=True):
        assert are_equal(prediction, other)
    assert not are_equal(predicted[0], replace(predicted[1], token=tokens[0]))


def test_the_seed_changes_the_draws_but_not_the_mean(
    model: V2XFormer, da: DeepAccident, tokens: list[str], predicted: list[SamplePrediction]
) -> None:
    [other] = predict(model, da, tokens[:1], PredictConfig(seed=1))

    first, second, mean = [heads.segmentation for heads in predicted[0].motion.heads or ()]
    other_first, other_second, other_mean = [
        heads.segmentation for heads in other.motion.heads or ()
    ]
    assert not np.array_equal(first, other_first)
    assert not np.array_equal(second, other_second)
    assert np.array_equal(mean, other_mean)
    assert not np.array_equal(first, second)


def test_partners_and_the_link_matter(
    model: V2XFormer, da: DeepAccident, tokens: list[str], predicted: list[SamplePrediction]
) -> None:
    single, late, lost = (
        predict(model, da, tokens[:1], PredictConfig(**options))[0]
        for options in (
            {"agents": "single"},
            {"link": Link(latency=0.2)},
            {"link": Link(packet_loss=1.0)},
        )
    )
    assert not are_equal(single, predicted[0])
    assert not are_equal(late, predicted[0])
    for values, expected in zip(iterate_arrays(lost), iterate_arrays(single), strict=True):
        np.testing.assert_allclose(values, expected, atol=1e-4)


def test_a_release_without_images_is_refused(
    model: V2XFormer, release_root: Path, moment: list[str], tmp_path: Path
) -> None:
    """A release has no images, for example, until its camera archives are unpacked."""
    root = shutil.copytree(
        release_root,
        tmp_path / "release",
        ignore=shutil.ignore_patterns(".deepaccident", "Camera_*"),
    )
    da = DeepAccident("v1", root, verbose=False)
    assert_raises(
        (
            lambda: predict(model, da, moment[:1]),
            NotAvailableError,
            ("no images", "unpack", "--sensors cameras"),
        )
    )
    assert predict(model, da, []) == []


@pytest.mark.parametrize(
    ("make_config", "sensors"), [(small_lidar_config, "clouds"), (small_both_config, "all")]
)
def test_a_release_without_point_clouds_is_refused_by_models_that_need_them(
    release_root: Path,
    moment: list[str],
    tmp_path: Path,
    make_config: Callable[[], ModelConfig],
    sensors: str,
) -> None:
    root = shutil.copytree(
        release_root,
        tmp_path / "release",
        ignore=shutil.ignore_patterns(".deepaccident", "lidar01"),
    )
    da = DeepAccident("v1", root, verbose=False)
    model = V2XFormer(make_config()).eval()
    with pytest.raises(NotAvailableError, match=rf"no point clouds.*--sensors {sensors}$"):
        predict(model, da, moment[:1])


def test_results_are_written_and_read(
    model: V2XFormer,
    da: DeepAccident,
    tokens: list[str],
    predicted: list[SamplePrediction],
    tmp_path: Path,
) -> None:
    paths = predict_results(model, da, tokens, tmp_path / "results")
    assert [*paths] == ["motion", "accident", "detection", "forecasting"]
    for task, path in paths.items():
        results = read_results(path)
        assert (results.task, results.meta["agents"]) == (task, "all")
        assert set(results.tokens) == set(tokens)

    form: Any = {
        "grid": model.config.labels.grid,
        "step": 0.1,
        "labels": "clean",
        "store": "heads",
    }
    with ResultsWriter(tmp_path / "heads", "motion", **form) as writer:
        for prediction in predicted:
            writer.add(prediction.token, prediction.motion)
    assert (tmp_path / "heads").is_dir()


MESSAGE_BYTES = 24 + 8 * 40 * 40 * 4
"""Size of the pose and the map that an agent of the small model sends."""


def predict_byte_notes(
    model: V2XFormer, da: DeepAccident, tokens: list[str], out: Path, config: PredictConfig
) -> Any:
    paths = predict_results(model, da, tokens, out, config)
    notes = [read_results(path).meta["bytes"] for path in paths.values()]
    assert notes[0] == notes[1] == notes[2]
    return notes[0]


def test_results_note_the_features_that_partners_send(
    model: V2XFormer, da: DeepAccident, tokens: list[str], tmp_path: Path
) -> None:
    form = {
        "payload": "bev",
        "shape": [8, 40, 40],
        "dtype": "float32",
        "samples": 3,
        "budget": None,
    }
    notes = predict_byte_notes(model, da, tokens, tmp_path / "all", DEFAULT_CONFIG)
    means = {"mean": 4.0 * MESSAGE_BYTES, "link": float(MESSAGE_BYTES), "partners": 4.0}
    assert notes == form | means

    no_bytes = {"mean": 0.0, "link": 0.0, "partners": 0.0}
    for name, config in (
        ("single", PredictConfig(agents="single")),
        ("lost", PredictConfig(link=Link(packet_loss=1.0))),
    ):
        notes = predict_byte_notes(model, da, tokens, tmp_path / name, config)
        assert notes == form | no_bytes


def test_a_budget_counts_the_models_own_features(
    model: V2XFormer, da: DeepAccident, tokens: list[str], tmp_path: Path
) -> None:
    budget = 3 * MESSAGE_BYTES - 1
    config = PredictConfig(link=Link(budget=budget, payload="bev"))
    with patch.object(
        V2XFormer, "forward", autospec=True, side_effect=V2XFormer.forward
    ) as forward:
        notes = predict_byte_notes(model, da, tokens, tmp_path / "some", config)

    assert (notes["partners"], notes["mean"]) == (2.0, 2.0 * MESSAGE_BYTES)
    assert notes["budget"] == budget
    partners = [call.args[1].partners.tolist() for call in forward.call_args_list]
    assert partners == [[[True, True, True, False, False]]] * 3


class TestPerfectMaps:
    """Predictions from exact maps, which replace the maps of the heads."""

    @pytest.fixture(params=[small_config, small_released_config])
    def model(self, request: pytest.FixtureRequest) -> V2XFormer:
        return V2XFormer(request.param()).eval()

    @pytest.mark.parametrize("row", [0, 3, 4])
    def test_boxes_are_at_their_places_in_the_world(
        self,
        model: V2XFormer,
        da: DeepAccident,
        moment: list[str],
        monkeypatch: pytest.MonkeyPatch,
        row: int,
    ) -> None:
        config, token = model.config, moment[row]
        item = load_item(da, token, points=False)
        is_inside = (item["boxes"][:, :2].abs() < 45).all(1)
        boxes = mirrored_boxes(item["boxes"][is_inside], config.handedness)
        categories = item["categories"][is_inside]
        targets = detection_targets([boxes], [categories], config.detection, config.targets)
        replace_outputs(monkeypatch, lambda _: {"detection": perfect_maps(targets)})

        [prediction] = predict(model, da, [token])

        predicted_boxes = prediction.boxes.boxes
        truth = da.boxes(token, "world", "released")[is_inside.numpy()]
        assert predicted_boxes.frame == "world"
        assert len(truth) > 3
        distances = np.linalg.norm(predicted_boxes.center[:, None] - truth.center, axis=-1)
        matches = distances.argmin(1)
        assert sorted(matches) == list(range(len(truth)))
        rows, expected_rows = (
            np.column_stack(
                [
                    boxes.center,
                    boxes.size,
                    np.cos(boxes.yaw),
                    np.sin(boxes.yaw),
                    np.nan_to_num(boxes.velocity)[:, :2],
                    boxes.category,
                ]
            )
            for boxes in (predicted_boxes, truth.select(matches))
        )
        np.testing.assert_allclose(rows, expected_rows, atol=2e-3, rtol=0)

    def test_motion_maps_score_as_their_labels(
        self,
        model: V2XFormer,
        da: DeepAccident,
        moment: list[str],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        token, config = moment[0], model.config
        label = motion_labels(da, token, config.labels).to_present("bilinear")
        heads = MotionHeads.from_labels(label)
        centerness = logit(heads.centerness.clip(1e-6, 1 - 1e-6))
        tensors = [
            torch.as_tensor(np.array(values))[None, None].float()
            for values in (heads.segmentation, centerness, heads.offset, heads.flow)
        ]
        maps = PredictedMotionMaps(*tensors)
        replace_outputs(
            monkeypatch,
            lambda outputs: {"motion": outputs.motion._replace(maps=maps)},
        )

        [prediction] = predict(model, da, [token])

        evaluator = MotionEvaluator(
            replace(MOTION_PROTOCOLS["paper"], labels=config.labels_protocol)
        )
        evaluator.update(token, prediction.motion, label)
        scores = evaluator.compute().ranges["100x100"]
        assert scores.iou == pytest.approx(100)
        assert scores.pq > 90


def replace_outputs(
    monkeypatch: pytest.MonkeyPatch, make_fields: Callable[[Any], dict[str, Any]]
) -> None:
    forward = V2XFormer.forward

    def changed_forward(*arguments: Any, **options: Any) -> Any:
        outputs = forward(*arguments, **options)
        return outputs._replace(**make_fields(outputs))

    monkeypatch.setattr(V2XFormer, "forward", changed_forward)


def test_delays_reach_the_model(model: V2XFormer, da: DeepAccident, tokens: list[str]) -> None:
    with patch.object(
        V2XFormer, "forward", autospec=True, side_effect=V2XFormer.forward
    ) as forward:
        predict(model, da, tokens[:1], PredictConfig(link=Link(latency=0.3)))
    delays = [call.args[1].delay.tolist() for call in forward.call_args_list]
    assert delays == [[[0, 3, 3, 3, 3]]]
