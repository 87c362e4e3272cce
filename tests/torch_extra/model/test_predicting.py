"""Predictions of samples: they stand by themselves, and the devkit's evaluators and writers take
them.
"""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import torch
from refusals import assert_refused
from scipy.special import logit
from torch_extra.model.perfect import perfect_maps
from torch_extra.model.small_model import small, small_lidar, small_released

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
from deepaccident_devkit.plugins.model.network import V2XFormer
from deepaccident_devkit.plugins.model.results import (
    PredictConfig,
    SamplePrediction,
    predict_results,
    predictions,
)
from deepaccident_devkit.training.torch import V2XConfig, V2XDataset
from deepaccident_devkit.v2x import Link

Seeded = Callable[..., V2XFormer]
ALL = PredictConfig()


def predict(
    model: V2XFormer, da: DeepAccident, tokens: list[str], config: PredictConfig = ALL
) -> list[SamplePrediction]:
    return list(predictions(model, da, tokens, config))


def arrays(found: SamplePrediction) -> Iterator[np.ndarray]:
    """All numbers of a prediction."""
    for heads in found.motion.heads or ():
        yield from (heads.segmentation, heads.centerness, heads.offset, heads.flow)
    boxes = found.boxes.boxes
    yield from (boxes.center, boxes.size, boxes.yaw, boxes.velocity, found.boxes.scores)
    yield from (each.positions for each in found.accidents)
    yield np.array([[each.time, each.score] for each in found.accidents])


def same(one: SamplePrediction, other: SamplePrediction) -> bool:
    pairs = list(zip(arrays(one), arrays(other), strict=True))
    return one.token == other.token and all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


def motion_evaluator(model: V2XFormer) -> MotionEvaluator:
    """For the labels that a model learns."""
    return MotionEvaluator(replace(MOTION_PROTOCOLS["paper"], labels=model.config.labels_protocol))


@pytest.fixture(scope="module")
def model(seeded: Seeded) -> V2XFormer:
    return seeded(small())


@pytest.fixture(scope="module")
def tokens(moment: list[str]) -> list[str]:
    return [moment[0], moment[4], moment[2].replace("/004", "/005")]


@pytest.fixture(scope="module")
def found(model: V2XFormer, da: DeepAccident, tokens: list[str]) -> list[SamplePrediction]:
    return predict(model, da, tokens)


def test_a_prediction_does_not_depend_on_others(
    model: V2XFormer, da: DeepAccident, tokens: list[str], found: list[SamplePrediction]
) -> None:
    """Nor on torch's own generator."""
    assert [each.token for each in found] == tokens
    torch.manual_seed(99)
    for one, other in zip(found, predict(model, da, tokens[::-1])[::-1], strict=True):
        assert same(one, other)
    assert not same(found[0], replace(found[1], token=tokens[0]))


def test_the_seed_changes_the_draws_but_not_the_mean(
    model: V2XFormer, da: DeepAccident, tokens: list[str], found: list[SamplePrediction]
) -> None:
    [other] = predict(model, da, tokens[:1], PredictConfig(seed=1))
    segmentations = [
        [heads.segmentation for heads in each.motion.heads or ()] for each in (found[0], other)
    ]
    assert [np.array_equal(*pair) for pair in zip(*segmentations, strict=True)] == [
        False,
        False,
        True,
    ]
    assert not np.array_equal(*segmentations[0][:2])


def test_partners_and_the_link_matter(
    model: V2XFormer, da: DeepAccident, tokens: list[str], found: list[SamplePrediction]
) -> None:
    links = ({"agents": "single"}, {"link": Link(latency=0.2)}, {"link": Link(packet_loss=1.0)})
    single, late, lost = (
        predict(model, da, tokens[:1], PredictConfig(**each))[0] for each in links
    )
    assert (same(single, found[0]), same(late, found[0])) == (False, False)
    for a, b in zip(arrays(lost), arrays(single), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)


def test_a_release_without_images_is_refused(
    model: V2XFormer, release_root: Path, moment: list[str], tmp_path: Path
) -> None:
    """Such as one whose camera archives were not unpacked."""
    shutil.copytree(
        release_root, tmp_path / "blind", ignore=shutil.ignore_patterns(".deepaccident", "Camera_*")
    )
    blind, named = (
        DeepAccident("v1", tmp_path / "blind", verbose=False),
        ("no images", "unpack", "--sensors cameras"),
    )
    assert_refused((lambda: predict(model, blind, moment[:1]), NotAvailableError, named))
    assert predict(model, blind, []) == []


def test_a_release_without_point_clouds_is_refused_by_models_that_need_them(
    release_root: Path, moment: list[str], tmp_path: Path
) -> None:
    shutil.copytree(
        release_root, tmp_path / "flat", ignore=shutil.ignore_patterns(".deepaccident", "lidar01")
    )
    flat = DeepAccident("v1", tmp_path / "flat", verbose=False)
    with pytest.raises(NotAvailableError, match=r"no point clouds.*--sensors all"):
        predict(V2XFormer(small_lidar()).eval(), flat, moment[:1])


def test_results_are_written_and_read(
    model: V2XFormer,
    da: DeepAccident,
    tokens: list[str],
    found: list[SamplePrediction],
    tmp_path: Path,
) -> None:
    paths = predict_results(model, da, tokens, tmp_path / "results")
    assert [*paths] == ["motion", "accident", "detection", "forecasting"]
    for task, path in paths.items():
        results = read_results(path)
        assert (results.task, set(results.tokens), results.meta["agents"]) == (
            task,
            set(tokens),
            "all",
        )
    form: Any = {"grid": model.config.labels.grid, "step": 0.1, "labels": "clean", "store": "heads"}
    with ResultsWriter(tmp_path / "heads", "motion", **form) as writer:
        for each in found:
            writer.add(each.token, each.motion)
    assert (tmp_path / "heads").is_dir()


FEATURES = 24 + 8 * 40 * 40 * 4
"""Bytes of the map that an agent of `small` sends, and its pose."""


def sent(
    model: V2XFormer, da: DeepAccident, tokens: list[str], out: Path, config: PredictConfig
) -> Any:
    """What results note of the bytes."""
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
    means = {"mean": 4.0 * FEATURES, "link": float(FEATURES), "partners": 4.0}
    assert sent(model, da, tokens, tmp_path / "all", ALL) == form | means
    nothing = {"mean": 0.0, "link": 0.0, "partners": 0.0}
    assert (
        sent(model, da, tokens, tmp_path / "single", PredictConfig(agents="single"))
        == form | nothing
    )
    lossy = PredictConfig(link=Link(packet_loss=1.0))
    assert sent(model, da, tokens, tmp_path / "lost", lossy) == form | nothing


def test_a_budget_is_of_the_models_own_features(
    model: V2XFormer, da: DeepAccident, tokens: list[str], tmp_path: Path
) -> None:
    config = PredictConfig(link=Link(budget=3 * FEATURES - 1, payload="bev"))
    with patch.object(
        V2XFormer, "forward", autospec=True, side_effect=V2XFormer.forward
    ) as forward:
        note = sent(model, da, tokens, tmp_path / "some", config)
    assert (note["partners"], note["mean"], note["budget"]) == (
        2.0,
        2.0 * FEATURES,
        3 * FEATURES - 1,
    )
    heard = [call.args[1].partners.tolist() for call in forward.call_args_list]
    assert heard == [[[True, True, True, False, False]]] * 3


class TestPerfectMaps:
    """Maps that say exactly what is there, in the place of the heads', come out where it is."""

    @pytest.fixture(params=[small, small_released])
    def perfect(self, request: pytest.FixtureRequest) -> V2XFormer:
        return V2XFormer(request.param()).eval()

    @pytest.mark.parametrize("row", [0, 3, 4])
    def test_boxes_are_at_their_places_in_the_world(
        self,
        perfect: V2XFormer,
        da: DeepAccident,
        moment: list[str],
        monkeypatch: pytest.MonkeyPatch,
        row: int,
    ) -> None:
        config, token = perfect.config, moment[row]
        item = V2XDataset(da, [token], V2XConfig(points=False))[0]
        inside = (item["boxes"][:, :2].abs() < 45).all(1)
        boxes = mirrored_boxes(item["boxes"][inside], config.handedness)
        targets = detection_targets(
            [boxes], [item["categories"][inside]], config.detection, config.targets
        )
        monkeypatch.setattr(
            V2XFormer,
            "forward",
            told(lambda found: found._replace(detection=perfect_maps(targets))),
        )
        [prediction] = predict(perfect, da, [token])
        found, truth = prediction.boxes.boxes, da.boxes(token, "world", "released")[inside.numpy()]
        assert (len(truth) > 3, found.frame) == (True, "world")
        match = np.linalg.norm(found.center[:, None] - truth.center, axis=-1).argmin(1)
        assert sorted(match) == list(range(len(truth)))
        rows = [
            np.column_stack(
                [
                    each.center,
                    each.size,
                    np.cos(each.yaw),
                    np.sin(each.yaw),
                    velocity,
                    each.category,
                ]
            )
            for each in (found, truth.select(match))
            for velocity in [np.nan_to_num(each.velocity)[:, :2]]
        ]
        np.testing.assert_allclose(*rows, atol=2e-3, rtol=0)

    def test_motion_maps_score_as_their_labels(
        self,
        perfect: V2XFormer,
        da: DeepAccident,
        moment: list[str],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        token, evaluator = moment[0], motion_evaluator(perfect)
        label = motion_labels(da, token, perfect.config.labels).to_present("bilinear")
        heads = MotionHeads.from_labels(label)
        centerness = logit(heads.centerness.clip(1e-6, 1 - 1e-6))
        fields = (heads.segmentation, centerness, heads.offset, heads.flow)
        maps = PredictedMotionMaps(
            *[torch.as_tensor(np.array(each))[None, None].float() for each in fields]
        )
        motion = told(lambda found: found._replace(motion=found.motion._replace(maps=maps)))
        monkeypatch.setattr(V2XFormer, "forward", motion)
        evaluator.update(token, predict(perfect, da, [token])[0].motion, label)
        scores = evaluator.compute().ranges["100x100"]
        assert (scores.iou, scores.pq > 90) == (pytest.approx(100), True)


def told(change: Callable[[Any], Any]) -> Callable[..., Any]:
    """A `forward` with a change in what it gives."""
    forward = V2XFormer.forward
    return lambda *arguments, **options: change(forward(*arguments, **options))


def test_delays_reach_the_model(model: V2XFormer, da: DeepAccident, tokens: list[str]) -> None:
    """From the link, for fusions that know them."""
    with patch.object(
        V2XFormer, "forward", autospec=True, side_effect=V2XFormer.forward
    ) as forward:
        predict(model, da, tokens[:1], PredictConfig(link=Link(latency=0.3)))
    assert [call.args[1].delay.tolist() for call in forward.call_args_list] == [[[0, 3, 3, 3, 3]]]
