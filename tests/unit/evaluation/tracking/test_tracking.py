"""Tracking on small scenes: swapped, shared and changing ids, gaps, edges, errors, pictures."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.expected_errors import assert_raises
from support.track_scenes import evaluate_rows, make_boxes, track_samples

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError, EvaluationError, GeometryError, ResultsError
from deepaccident_devkit.evaluation import ResultsWriter, read_results
from deepaccident_devkit.evaluation.runs import evaluate_results
from deepaccident_devkit.evaluation.runs.sanity import check_sanity
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.evaluation.tracking import (
    TRACKING_PROTOCOLS,
    TrackingEvaluator,
    TrackingTruth,
    Tracks,
    tracking_truth,
)

FRAMES = (5, 10, 15, 20, 25, 30)
TRUE_XY = {"a": (0.0, 0.0), "b": (0.0, 10.0)}
SPEED_MPS = 2.0
IdAt = Callable[[str, int], str | None]


def keep_id(actor: str, _frame: int) -> str:
    return actor


def make_recording(id_at: IdAt = keep_id, offset: float = 0.0) -> dict[str, Any]:
    """Let two cars drive along x, and follow them with the ids of a function, None for a gap."""
    truth = []
    tracks = []
    for frame in FRAMES:
        for number, (actor, (x, y)) in enumerate(TRUE_XY.items()):
            place = [x + SPEED_MPS * frame / 10, y, 0.0]
            truth.append([frame, number, "car", *place])
            track = id_at(actor, frame)
            if track is not None:
                tracks.append([frame, track, "car", place[0], place[1] + offset, 0.0, 0.5])
    return {"frames": FRAMES, "truth": truth, "tracks": tracks}


def swap_from_20(actor: str, frame: int) -> str:
    if frame < 20:
        return actor
    return {"a": "b", "b": "a"}[actor]


@pytest.mark.parametrize("protocol", TRACKING_PROTOCOLS)
def test_swapped_ids_are_switches_and_a_gap_is_a_fragment(protocol: str) -> None:
    def leave_gap(actor: str, frame: int) -> str | None:
        return None if (actor, frame) == ("a", 15) else actor

    perfect = evaluate_rows({"s/ego": make_recording()}, protocol).class_mean
    swapped = evaluate_rows({"s/ego": make_recording(swap_from_20)}, protocol).class_mean
    gap = evaluate_rows({"s/ego": make_recording(leave_gap)}, protocol, **without_filling(protocol))

    assert (perfect["id_switches"], perfect["fragments"], perfect["mota"]) == (0, 0, 1.0)
    assert (swapped["id_switches"], swapped["fragments"]) == (2, 0)
    assert swapped["mota"] == pytest.approx(1 - 2 / 12)
    assert (gap.class_mean["id_switches"], gap.class_mean["fragments"]) == (0, 1)
    assert gap.class_mean["fn"] == 1


def without_filling(protocol: str) -> dict[str, str]:
    return {"interpolation": "none"} if protocol == "nuscenes" else {}


def test_half_a_swapped_track_has_the_hota_of_its_definition() -> None:
    result = evaluate_rows({"s/ego": make_recording(swap_from_20)})

    # each actor has 3 boxes with each of two tracks of 6 boxes: 3 / (6 + 6 - 3)
    assert result.class_mean["ass_a"] == pytest.approx(1 / 3)
    assert result.class_mean["hota"] == pytest.approx(np.sqrt(1 / 3))
    assert result.class_mean["idf1"] == pytest.approx(0.5)


@pytest.mark.parametrize("protocol", TRACKING_PROTOCOLS)
def test_ids_of_other_recordings_are_other_tracks(protocol: str) -> None:
    shared = {"s/ego": make_recording(), "s/pole": make_recording(swap_from_20)}
    renamed = dict(shared)
    renamed["s/pole"] = make_recording(lambda actor, frame: f"x{swap_from_20(actor, frame)}")

    assert evaluate_rows(shared, protocol) == evaluate_rows(renamed, protocol)


@pytest.mark.parametrize("protocol", TRACKING_PROTOCOLS)
def test_order_and_pooling_change_no_number(protocol: str) -> None:
    recordings = {"s/ego": make_recording(swap_from_20, 0.3), "t/ego": make_recording()}
    samples = list(track_samples(recordings))
    evaluator = TrackingEvaluator(protocol, ranges=(1e6,))
    for number in np.random.default_rng(1).permutation(len(samples)):
        evaluator.update(*samples[number])
    parts = evaluator.clustered({token: token.split("/")[0] for token, _, _ in samples})
    pooled = [entry for part in parts for entry in evaluator.pooled(part)]

    assert json.loads(json.dumps(dict(evaluator.counts))) == dict(evaluator.counts)
    assert evaluator.result_of(pooled) == evaluator.compute()
    assert evaluator.compute() == evaluate_rows(recordings, protocol)


@pytest.mark.parametrize(
    ("protocol", "distance", "tp", "hota_is_zero"),
    [
        ("clean", 1.0, 12, False),
        ("clean", 1.0001, 0, False),
        ("clean", 2.0, 0, True),
        ("nuscenes", 1.9999, 12, None),
        ("nuscenes", 2.0, 0, None),
    ],
)
def test_distances_at_the_edge(
    protocol: str, distance: float, tp: int, hota_is_zero: bool | None
) -> None:
    numbers = evaluate_rows({"s/ego": make_recording(offset=distance)}, protocol).class_mean

    assert numbers["tp"] == tp
    if hota_is_zero is not None:
        assert (numbers["hota"] == 0) == hota_is_zero


def test_range_includes_its_edge_in_a_square_and_not_on_a_circle() -> None:
    rows = [[5, 1, "car", 40.0, 0.0, 0.0], [5, 2, "car", 40.0, 40.0, 0.0]]
    truth = TrackingTruth(boxes=make_boxes(rows, actor_id=[1, 2]))
    nothing = Tracks(boxes=make_boxes([]), scores=np.zeros(0), ids=[])  # type: ignore[arg-type]

    for shape, true_boxes in (("square", 2), ("circle", 0)):
        evaluator = TrackingEvaluator("clean", ranges=(40.0,), shape=shape)
        evaluator.update("s/ego/005", nothing, truth)
        assert evaluator.compute().pooled["true_boxes"] == true_boxes


@pytest.mark.parametrize(("interpolation", "amota"), [("straight", 1.0), ("mirrored", 0.3125)])
def test_long_gaps_are_filled_straight_or_mirrored(interpolation: str, amota: float) -> None:
    recording = make_recording(lambda actor, frame: None if 5 < frame < 25 else actor)

    result = evaluate_rows({"s/ego": recording}, "nuscenes", interpolation=interpolation)

    # mirrored: 8 of 12 boxes match and 4 are false, which is 0.5 at 25 of 40 levels of recall
    assert result.class_mean["amota"] == pytest.approx(amota)


def test_equal_scores_have_one_threshold() -> None:
    def leave_out(actor: str, frame: int) -> str | None:
        return None if (actor, frame) == ("b", 30) else actor

    numbers = evaluate_rows({"s/ego": make_recording(leave_out, 0.5)}, "nuscenes").class_mean

    # 11 of 12 boxes: the 36 levels of recall up to 0.9 are reached, all without false boxes
    assert numbers["amota"] == pytest.approx(36 / 40)
    assert numbers["amotp"] == pytest.approx((36 * 0.5 + 4 * 2.0) / 40)


def test_wrong_arguments_are_refused() -> None:
    evaluator = TrackingEvaluator()
    [(token, tracks, truth), *_] = track_samples({"s/ego": make_recording()})
    moved = Tracks(
        boxes=tracks.boxes.transform(truth.world_from_agent, "lidar"),
        scores=tracks.scores,
        ids=tracks.ids,
    )
    assert_raises(
        (lambda: evaluator.update(token, tracks.boxes, truth), EvaluationError, "from_arrays"),  # type: ignore[arg-type]
        (lambda: evaluator.update(token, moved, truth), GeometryError, (token, "lidar", "world")),
        (lambda: evaluator.update("005", tracks, truth), EvaluationError, ("005", "recording")),
        (
            lambda: Tracks(boxes=tracks.boxes, scores=tracks.scores, ids=[7, 7]),  # type: ignore[arg-type]
            GeometryError,
            ("ids", "different", "7"),
        ),
        (lambda: TrackingEvaluator(ranges=(1.0, 2.0)), ConfigError, ("ranges", "6 classes")),
    )


def follow_truth(dataset: DeepAccident, token: str, suffix: str = "") -> Tracks:
    """Return the true boxes of a sample as tracks, whose ids are the actors' with a suffix."""
    boxes = tracking_truth(dataset, token, TRACKING_PROTOCOLS["clean"]).boxes
    return Tracks.from_arrays(
        boxes.center,
        boxes.size,
        boxes.yaw,
        np.linspace(1, 0.5, len(boxes)),
        ids=[f"{actor}{suffix}" for actor in boxes.actor_id.tolist()],
        frame="world",
        category=boxes.category,
        velocity=boxes.velocity,
    )


def write_tracks(
    dataset: DeepAccident, path: Path, tokens: list[str], *, new_ids: bool = False
) -> Path:
    with ResultsWriter(path, "tracking") as writer:
        for token in tokens:
            suffix = token[-3:] if new_ids else ""
            writer.add(token, follow_truth(dataset, token, suffix))
    return path


@pytest.fixture(scope="module")
def tokens(da_motion: DeepAccident) -> list[str]:
    return [token for token in da_motion.samples("train", "all") if "/ego_vehicle/" in token]


def test_written_tracks_are_read_and_drawn(
    da_motion: DeepAccident, tokens: list[str], tmp_path: Path
) -> None:
    results = read_results(write_tracks(da_motion, tmp_path / "tracks.json", tokens))
    evaluator = TrackingEvaluator()
    token = tokens[3]

    tracks = evaluator.read(results, da_motion, token)
    written = follow_truth(da_motion, token)
    drawing = evaluator.drawing(
        da_motion, token, tracks, *evaluator.truth(da_motion, token, None, 2.0)
    )

    assert tracks.ids.tolist() == written.ids.tolist()
    np.testing.assert_allclose(tracks.boxes.center, written.boxes.center)
    assert tracks.past_times.tolist() == pytest.approx([-1.5, -1.0, -0.5])
    counts = {part.role: len(part.boxes) for part in drawing.boxes}
    assert counts["right"] == counts["truth"] > 0
    assert counts["false"] == counts["missed"] == 0
    paths = [path for path in drawing.paths if path.role == "right"]
    assert len(paths) == counts["right"]
    assert paths[0].times[-1] == 0.0


def test_recording_that_lacks_a_sample_is_left_out(
    da_motion: DeepAccident, tokens: list[str], tmp_path: Path
) -> None:
    path = write_tracks(da_motion, tmp_path / "tracks.json", tokens[1:])
    setup = EvaluationSetup(task="tracking", protocol="clean")
    recording = tokens[0].rpartition("/")[0]

    with pytest.raises(ResultsError, match="without a prediction"):
        evaluate_results(da_motion, path, setup, "train", workers=1)
    run = evaluate_results(da_motion, path, setup, "train", workers=1, allow_partial=True)

    assert run.partial is not None
    assert run.evaluator.tokens
    assert not any(token.startswith(recording) for token in run.evaluator.tokens)
    assert run.result.class_mean["hota"] == pytest.approx(1.0)
    assert "truth: actors that any agent sees" in run.result.notes[0]


@pytest.mark.parametrize("new_ids", [False, True])
def test_sanity_notices_ids_that_change_at_every_sample(
    da_motion: DeepAccident, tokens: list[str], tmp_path: Path, new_ids: bool
) -> None:
    path = write_tracks(da_motion, tmp_path / "tracks.json", tokens, new_ids=new_ids)
    setup = EvaluationSetup(task="tracking", protocol="clean")

    report = check_sanity(da_motion, read_results(path), setup, tokens)

    assert ("ids of single samples" in report.warnings_text()) == new_ids
