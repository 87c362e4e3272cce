"""The true boxes of each protocol."""

from pathlib import Path

import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.evaluation.detection import DetectedBoxes, detection_protocol, detection_truth
from deepaccident_devkit.geometry import SE3


def test_the_truth_of_each_protocol(da: DeepAccident) -> None:
    sample = da.get_sample(da.scenario[0]["token"], "ego_vehicle", 3)
    every = da.boxes(sample, "lidar")
    released = detection_truth(da, sample)
    assert released.actor_id.tolist() == every.actor_id.tolist()
    rows = da.annotation_rows(sample)
    np.testing.assert_array_equal(released.velocity[:, :2], da.columns("annotation")["velocity_label"][rows])
    paper = detection_truth(da, sample, "paper")
    assert paper.actor_id.tolist() == da.boxes(sample, "lidar", "released").actor_id.tolist()
    cooperative = detection_truth(da, sample, "opencood")
    alone = detection_truth(da, sample, "opencood", agents="single")
    own = da.get("agent", sample["agent_token"])["actor_id"]
    assert own not in cooperative.actor_id
    assert own in detection_truth(da, sample, detection_protocol("opencood", own_box=True)).actor_id
    assert set(alone.actor_id.tolist()) <= set(cooperative.actor_id.tolist())
    assert {each.frame for each in (released, paper, cooperative)} == {"lidar"}
    assert_refused(
        (lambda: detection_truth(da, sample, "paper", agents="single"), ConfigError, "choose truth='cooperative'"),
        (
            lambda: detection_truth(da, sample, detection_protocol("opencood", label_velocity=True)),
            ConfigError,
            "label_velocity",
        ),
    )


def test_detected_boxes_say_their_frame_and_change_it() -> None:
    arrays = [[1.0, 2.0, 3.0]], [[4.0, 2.0, 1.5]], [0.5], [0.9]
    moved = DetectedBoxes.from_arrays(*arrays, frame="lidar").transform(SE3.from_yaw(0, (10, 0, 0)), "world")
    assert (moved.boxes.frame, moved.boxes.center.tolist(), moved.scores.tolist()) == ("world", [[11, 2, 3]], [0.9])


def test_a_sample_without_label_has_no_truth(own_release: Path) -> None:
    for path in own_release.rglob("label"):
        for file in path.rglob("*.txt"):
            file.unlink()
    opened = DeepAccident("v1", own_release, verbose=False, on_error="skip")
    with pytest.raises(NotAvailableError, match="has no label"):
        detection_truth(opened, opened.sample[0])
