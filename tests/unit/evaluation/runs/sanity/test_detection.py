"""Detections in other frames, mirrored, scaled, shifted, with other sizes or headings are named; good ones are not."""

from collections.abc import Callable

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.metrics.detection import DetectedBoxes, detection_truth
from deepaccident_devkit.evaluation.runs.sanity.detection import (
    DetectionMoments,
    detection_moments,
    detection_suspicions,
    detection_tallies,
)
from deepaccident_devkit.evaluation.runs.sanity.probes import SCALES, SYMMETRIES, candidates_of
from deepaccident_devkit.geometry import Boxes

Moments = dict[str, DetectionMoments]
Detect = Callable[[DeepAccident, str], DetectedBoxes]
"""The detections of a sample in the world frame."""


@pytest.fixture(scope="session")
def moments(crossing: DeepAccident, crossing_tokens: list[str]) -> Moments:
    """Of ten samples."""
    chosen = crossing_tokens[:: len(crossing_tokens) // 10]
    return {token: detection_moments(crossing, token, detection_truth(crossing, token)) for token in chosen}


def actors(dataset: DeepAccident, token: str, frame: str = "world", later: int = 0) -> Boxes:
    """All but the agent itself, so many recorded frames later."""
    row = dataset.getind("sample", token) + later
    boxes = dataset.boxes(dataset.sample[row]["token"], frame)
    return boxes.select(boxes.actor_id >= 0)


def detected(center: np.ndarray, size: np.ndarray, yaw: np.ndarray, frame: str = "world") -> DetectedBoxes:
    scores = np.random.default_rng(len(center)).uniform(size=len(center))
    return DetectedBoxes.from_arrays(center, size, yaw, scores, frame=frame)


def around(change: Callable[[Boxes], tuple[np.ndarray, np.ndarray, np.ndarray]], noise: float = 0.2) -> Detect:
    """Boxes that are a little off, and changed in the LiDAR frame: their centres, sizes and headings."""

    def detect(dataset: DeepAccident, token: str) -> DetectedBoxes:
        boxes = actors(dataset, token, "lidar")
        off = np.random.default_rng(len(boxes)).normal(0, noise, (len(boxes), 3))
        center, size, yaw = change(boxes)
        found = detected(center + off, size, yaw, "lidar")
        return DetectedBoxes(
            boxes=found.boxes.transform(dataset.world_from(token, "lidar"), "world"), scores=found.scores
        )

    return detect


def as_world(frame: str) -> Detect:
    """Boxes of another frame that are said to be the world's."""

    def detect(dataset: DeepAccident, token: str) -> DetectedBoxes:
        boxes = actors(dataset, token, frame)
        return detected(boxes.center, boxes.size, boxes.yaw)

    return detect


def at_another_time(later: int) -> Detect:
    """Boxes where the actors are so many recorded frames later."""

    def detect(dataset: DeepAccident, token: str) -> DetectedBoxes:
        boxes = actors(dataset, token, later=later)
        return detected(boxes.center, boxes.size, boxes.yaw)

    return detect


def in_world(change: Callable[[Boxes], tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Detect:
    """Boxes that are changed in the world frame."""
    return lambda dataset, token: detected(*change(actors(dataset, token)))


def anywhere(seed: int) -> Detect:
    """Forty boxes around the agent."""

    def detect(dataset: DeepAccident, token: str) -> DetectedBoxes:
        source = np.random.default_rng([seed, len(token), dataset.getind("sample", token)])
        center = actors(dataset, token).center.mean(axis=0) + source.uniform(-60, 60, (40, 3)) * (1, 1, 0.02)
        return detected(center, source.uniform(1, 5, (40, 3)), source.uniform(-np.pi, np.pi, 40))

    return detect


def turned(boxes: Boxes, angle: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return boxes.center, boxes.size, boxes.yaw + angle


MISTAKES: dict[str, Detect] = {
    **{
        each.name: around(
            lambda boxes, each=each: (
                np.column_stack([each.apply(boxes.center[:, :2]), boxes.center[:, 2]]),
                boxes.size,
                boxes.yaw,
            )
        )
        for each in SYMMETRIES
    },
    **{
        name: around(lambda boxes, scale=scale: (boxes.center * (scale, scale, 1), boxes.size, boxes.yaw))
        for name, scale in SCALES.items()
    },
    "ego frame": as_world("ego"),
    "lidar frame": as_world("lidar"),
    "left-handed world": in_world(lambda boxes: (boxes.center * (1, -1, 1), boxes.size, -boxes.yaw)),
    "0.5 s late": at_another_time(-5),
    "0.5 s early": at_another_time(5),
    "length and width swapped": around(lambda boxes: (boxes.center, boxes.size[:, [1, 0, 2]], boxes.yaw)),
    "heading turned by 90°": around(lambda boxes: turned(boxes, np.pi / 2)),
    "heading turned by 180°": around(lambda boxes: turned(boxes, np.pi)),
    "heading turned by 270°": around(lambda boxes: turned(boxes, -np.pi / 2)),
    "heading negated": around(lambda boxes: (boxes.center, boxes.size, -boxes.yaw)),
    "heading negated in the world": in_world(lambda boxes: (boxes.center, boxes.size, -boxes.yaw)),
}
FINE: dict[str, Detect] = {
    "perfect": in_world(lambda boxes: (boxes.center, boxes.size, boxes.yaw)),
    "noisy": around(lambda boxes: turned(boxes, 0.1), noise=0.6),
    "nothing": in_world(lambda boxes: (boxes.center[:0], boxes.size[:0], boxes.yaw[:0])),
    **{f"anywhere {seed}": anywhere(seed) for seed in (1, 2, 3)},
}


def suspected(dataset: DeepAccident, moments: Moments, detect: Detect) -> list[str]:
    tallies = []
    for token, known in moments.items():
        raw = detect(dataset, token)
        frame_from_world = known.world_from_frame.inverse()
        boxes = raw.boxes.transform(frame_from_world, known.truth.frame)
        tallies.append(detection_tallies(raw, DetectedBoxes(boxes=boxes, scores=raw.scores), known))
    return [each.name for each in candidates_of(detection_suspicions(), tallies) if each.suspected]


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_named_as_exactly_that(crossing: DeepAccident, moments: Moments, mistake: str) -> None:
    assert suspected(crossing, moments, MISTAKES[mistake]) == [mistake]


@pytest.mark.parametrize("detections", FINE)
def test_nothing_else_is_suspected(crossing: DeepAccident, moments: Moments, detections: str) -> None:
    assert suspected(crossing, moments, FINE[detections]) == []


def test_every_suspicion_is_tried() -> None:
    assert {each.name for each in detection_suspicions()} == set(MISTAKES)


def test_the_first_sample_of_an_agent_has_no_truth_before_it(da_motion: DeepAccident) -> None:
    token = next(each["token"] for each in da_motion.sample[:] if each["token"].endswith("/ego_vehicle/001"))
    known = detection_moments(da_motion, token, detection_truth(da_motion, token))
    assert len(known.moved[-5]) == 0 < len(known.moved[5])
