"""Detections with a mistake are named as exactly that, noisy ones too; good and bad ones without a mistake are not."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.baselines import predict_detections
from deepaccident_devkit.evaluation.metrics.detection import DetectedBoxes, detection_truth
from deepaccident_devkit.evaluation.runs.sanity.box_facts import box_counts, box_warnings
from deepaccident_devkit.evaluation.runs.sanity.classes import class_candidate, class_names
from deepaccident_devkit.evaluation.runs.sanity.detection import (
    DetectionMoments,
    detection_moments,
    detection_suspicions,
    detection_tallies,
)
from deepaccident_devkit.evaluation.runs.sanity.probes import SCALES, SYMMETRIES, candidates_of
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.v2x import Link

pytestmark = pytest.mark.slow

Moments = dict[str, DetectionMoments]
LAGS = {"0.5 s late": -5, "0.5 s early": 5}


@dataclass(frozen=True, eq=False)
class Found:
    """Boxes in the world frame and the agent's poses."""

    world_from_ego: SE3
    world_from_lidar: SE3
    center: np.ndarray
    size: np.ndarray
    yaw: np.ndarray
    category: np.ndarray
    velocity: np.ndarray
    scores: np.ndarray

    def select(self, which: np.ndarray) -> "Found":
        columns = ("center", "size", "yaw", "category", "velocity", "scores")
        return replace(self, **{name: getattr(self, name)[which] for name in columns})

    def detections(self) -> DetectedBoxes:
        return DetectedBoxes.from_arrays(
            *(self.center, self.size, self.yaw, self.scores),
            category=self.category,
            velocity=self.velocity,
            frame="world",
        )


Change = Callable[[Found], Found]
Detect = Callable[[DeepAccident, str], DetectedBoxes]


def actors(dataset: DeepAccident, token: str, later: int = 0) -> Found:
    """All but the agent itself, so many recorded frames later."""
    row = dataset.getind("sample", token) + later
    boxes = dataset.boxes(dataset.sample[row]["token"], "world")
    boxes = boxes.select(boxes.actor_id >= 0)
    return Found(
        world_from_ego=dataset.world_from(token, "ego"),
        world_from_lidar=dataset.world_from(token, "lidar"),
        center=boxes.center,
        size=boxes.size,
        yaw=boxes.yaw,
        category=boxes.category,
        velocity=boxes.velocity[:, :2],
        scores=np.random.default_rng(row).uniform(0.3, 1, len(boxes)),
    )


def noisy(found: Found, metres: float = 0.4, missing: float = 0.25, false: float = 0.3, seed: int = 0) -> Found:
    """Off in all they say, some missing, some classes confused, and false ones of lower scores between them."""
    source = np.random.default_rng([seed, len(found.yaw), int(abs(found.center.sum()))])
    kept = found.select(source.uniform(size=len(found.yaw)) >= missing)
    number, more = len(kept.yaw), int(np.ceil(false * len(kept.yaw)))
    around = kept.world_from_ego.translation + source.uniform(-50, 50, (more, 3)) * (1, 1, 0.02)
    confused = source.uniform(size=number) < 0.1
    scores = np.concatenate([kept.scores, source.uniform(0, 0.7, more)])
    return Found(
        world_from_ego=kept.world_from_ego,
        world_from_lidar=kept.world_from_lidar,
        center=np.concatenate([kept.center + source.normal(0, metres, (number, 3)) * (1, 1, 0.3), around]),
        size=np.concatenate([kept.size * np.exp(source.normal(0, 0.1, (number, 3))), source.uniform(1, 5, (more, 3))]),
        yaw=np.concatenate([kept.yaw + source.normal(0, 0.1, number), source.uniform(-3, 3, more)]),
        category=np.concatenate(
            [np.where(confused, source.integers(0, 6, number), kept.category), source.integers(0, 6, more)]
        ),
        velocity=np.concatenate([kept.velocity + source.normal(0, 0.5, (number, 2)), source.normal(0, 4, (more, 2))]),
        scores=np.clip(scores + source.normal(0, 0.1, number + more), 0, 1),
    )


def in_ego(change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]) -> Change:
    """Centres and headings that are changed in the ego frame."""

    def changed(found: Found) -> Found:
        world_from_ego, ego_from_world = found.world_from_ego, found.world_from_ego.inverse()
        center, yaw = change(ego_from_world.apply(found.center), found.yaw + ego_from_world.yaw)
        return replace(found, center=world_from_ego.apply(center), yaw=yaw + world_from_ego.yaw)

    return changed


def given_in_ego(sign: int) -> Change:
    """Boxes of the ego frame that are said to be the world's."""

    def changed(found: Found) -> Found:
        ego_from_world = found.world_from_ego.inverse()
        center = ego_from_world.apply(found.center) * (1, sign, 1)
        return replace(found, center=center, yaw=sign * (found.yaw + ego_from_world.yaw))

    return changed


def at_edge(along: int, across: int) -> Change:
    def changed(found: Found) -> Found:
        ahead, aside = (found.size[:, :2] / 2 * (along, across)).T
        cosine, sine = np.cos(found.yaw), np.sin(found.yaw)
        off = np.column_stack([cosine * ahead - sine * aside, sine * ahead + cosine * aside, 0 * ahead])
        return replace(found, center=found.center + off)

    return changed


def raised(share: float) -> Change:
    return lambda found: replace(found, center=found.center + found.size[:, 2:] * (0, 0, share))


def lifted(sign: int) -> Change:
    """Boxes of the LiDAR frame placed by the ego pose, with -1, or of the ego frame placed by the LiDAR's, with 1."""

    def changed(found: Found) -> Found:
        poses = found.world_from_lidar, found.world_from_ego
        own, other = poses if sign < 0 else poses[::-1]
        return replace(found, center=other.apply(own.inverse().apply(found.center)))

    return changed


def headed(change: Callable[[np.ndarray], np.ndarray], *, own: bool = False) -> Change:
    return in_ego(lambda center, yaw: (center, change(yaw))) if own else (lambda f: replace(f, yaw=change(f.yaw)))


def of_sizes(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda found: replace(found, size=change(found.size))


def moving(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda found: replace(found, velocity=change(found.velocity))


def named(names: list[int]) -> Change:
    return lambda found: replace(found, category=np.array(names)[found.category])


def moving_in_ego(found: Found) -> Found:
    turn = found.world_from_ego.inverse().rotation[:2, :2]
    return replace(found, velocity=found.velocity @ turn.T)


AXES = ("length", "width", "height")
FLIPS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "heading negated": lambda yaw: -yaw,
    "heading clockwise from y": lambda yaw: np.pi / 2 - yaw,
    "heading clockwise from -y": lambda yaw: -np.pi / 2 - yaw,
    "heading clockwise from -x": lambda yaw: np.pi - yaw,
}
EDGES = {
    "front left corner": (1, 1),
    "front right corner": (1, -1),
    "rear left corner": (-1, 1),
    "rear right corner": (-1, -1),
    "front end": (1, 0),
    "rear end": (-1, 0),
}
MISTAKES: dict[str, Change] = {
    **{
        each.name: in_ego(lambda center, yaw, each=each: (np.c_[each.apply(center[:, :2]), center[:, 2]], yaw))
        for each in SYMMETRIES
    },
    **{
        name: in_ego(lambda center, yaw, scale=scale: (center * (scale, scale, 1), yaw))
        for name, scale in SCALES.items()
    },
    "ego frame": given_in_ego(1),
    "left-handed ego frame": given_in_ego(-1),
    "left-handed world": lambda found: replace(found, center=found.center * (1, -1, 1), yaw=-found.yaw),
    "world axes around the agent": lambda f: replace(f, center=f.center - f.world_from_ego.translation),
    **{name: at_edge(*edge) for name, edge in EDGES.items()},
    **{
        "length and width swapped"
        if order == (1, 0, 2)
        else f"sizes as {', '.join(AXES[axis] for axis in order)}": of_sizes(lambda size, order=order: size[:, order])
        for order in permutations(range(3))
        if order != (0, 1, 2)
    },
    "sizes halved": of_sizes(lambda size: size / 2),
    "sizes doubled": of_sizes(lambda size: size * 2),
    "center at the bottom": raised(-0.5),
    "center at the top": raised(0.5),
    "lidar frame by the ego pose": lifted(-1),
    "ego frame by the lidar pose": lifted(1),
    "heading turned by 90°": headed(lambda yaw: yaw + np.pi / 2),
    "heading turned by 180°": headed(lambda yaw: yaw + np.pi),
    "heading turned by 270°": headed(lambda yaw: yaw - np.pi / 2),
    **{name: headed(flip, own=True) for name, flip in FLIPS.items()},
    **{f"{name} in the world": headed(flip) for name, flip in FLIPS.items()},
    "heading of the agent's frame": lambda found: replace(found, yaw=found.yaw - found.world_from_ego.yaw),
    **{f"velocity {each.name}": moving(each.apply) for each in SYMMETRIES},
    "velocity of the agent's frame": moving_in_ego,
    "velocity in km/h": moving(lambda velocity: velocity * 3.6),
}
CLASSES: dict[str, Change] = {
    "cars and trucks": named([1, 0, 2, 3, 4, 5]),
    "cars and pedestrians": named([5, 1, 2, 3, 4, 0]),
    "counted from 1": named([1, 2, 3, 4, 5, 0]),
    "alphabetical": named([0, 4, 5, 1, 2, 3]),
}


@pytest.fixture(scope="session")
def moments(crossing: DeepAccident, crossing_tokens: list[str]) -> Moments:
    """Of ten samples."""
    return moments_of(crossing, crossing_tokens[:: len(crossing_tokens) // 10])


@pytest.fixture(scope="module")
def few(da_motion: DeepAccident) -> Moments:
    """Of ten samples of an accident."""
    return moments_of(da_motion, da_motion.samples("train", "evaluate", "paper", scope="accident")[::2])


def moments_of(dataset: DeepAccident, tokens: list[str]) -> Moments:
    return {token: detection_moments(dataset, token, detection_truth(dataset, token)) for token in tokens}


def changed(change: Change, base: Change = lambda found: found) -> Detect:
    return lambda dataset, token: change(base(actors(dataset, token))).detections()


def suspected(dataset: DeepAccident, moments: Moments, detect: Detect) -> list[str]:
    tallies, names = [], np.zeros((6, 6), dtype=np.int64)
    for token, known in moments.items():
        raw = detect(dataset, token)
        boxes = raw.boxes.transform(known.world_from_frame.inverse(), known.truth.frame)
        found = DetectedBoxes(boxes=boxes, scores=raw.scores)
        tallies.append(detection_tallies(raw, found, known))
        names += class_names(found, known.truth)
    candidates = candidates_of(detection_suspicions(), tallies)
    places = {each.name for each in detection_suspicions() if each.group == "place"}
    found_wrong = [each.name for each in candidates if each.suspected]
    classes = class_candidate(names)
    return found_wrong + [classes.name] * (classes.suspected and not places & set(found_wrong))


@pytest.mark.parametrize("base", [lambda found: found, noisy], ids=["perfect", "noisy"])
@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_named_as_exactly_that(
    da_motion: DeepAccident, few: Moments, mistake: str, base: Change
) -> None:
    assert suspected(da_motion, few, changed(MISTAKES[mistake], base)) == [mistake]


@pytest.mark.slow
@pytest.mark.parametrize("base", [lambda found: found, noisy], ids=["perfect", "noisy"])
@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_named_in_other_scenes(
    crossing: DeepAccident, moments: Moments, mistake: str, base: Change
) -> None:
    assert suspected(crossing, moments, changed(MISTAKES[mistake], base)) == [mistake]


@pytest.mark.parametrize("base", [lambda found: found, noisy], ids=["perfect", "noisy"])
@pytest.mark.parametrize("names", CLASSES)
def test_swapped_classes_are_named(crossing: DeepAccident, moments: Moments, names: str, base: Change) -> None:
    assert suspected(crossing, moments, changed(CLASSES[names], base)) == ["classes swapped"]


@pytest.mark.parametrize("base", [lambda found: found, noisy], ids=["perfect", "noisy"])
@pytest.mark.parametrize("lag", LAGS)
def test_boxes_of_another_moment_are_named(crossing: DeepAccident, moments: Moments, lag: str, base: Change) -> None:
    def detect(dataset: DeepAccident, token: str) -> DetectedBoxes:
        return base(actors(dataset, token, LAGS[lag])).detections()

    assert suspected(crossing, moments, detect) == [lag]


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("base", [lambda found: found, noisy], ids=["perfect", "noisy"])
def test_degrees_are_named_if_only_as_headings_at_random(
    da_motion: DeepAccident, few: Moments, base: Change, own: bool
) -> None:
    """Degrees of noisy headings, taken for radians, are any headings."""
    (name,) = suspected(da_motion, few, changed(headed(np.rad2deg, own=own), base))
    assert name.startswith("heading in degrees")


def test_scores_the_wrong_way_round_are_named(crossing: DeepAccident, moments: Moments) -> None:
    upside_down = changed(lambda found: replace(found, scores=-found.scores), noisy)
    assert suspected(crossing, moments, upside_down) == ["scores the wrong way round"]


def all_called(names: list[int]) -> Change:
    return lambda found: named(names)(noisy(found))


def crooked(found: Found) -> Found:
    source = np.random.default_rng(int(abs(1e3 * found.center.sum())))
    return replace(found, yaw=found.yaw + source.normal(0, np.deg2rad(15), len(found.yaw)))


FINE: dict[str, Detect] = {
    "perfect": changed(lambda found: found),
    "noisy": changed(noisy),
    "noisier": changed(lambda found: noisy(found, 0.8, 0.4, 0.5)),
    "half missing": changed(lambda found: noisy(found, 0.2, 0.5, 0.0)),
    "false ones": changed(lambda found: noisy(found, 0.2, 0.0, 2.0)),
    "each one thrice": changed(lambda found: noisy(found).select(np.arange(3 * len(noisy(found).yaw)) // 3)),
    "a single vehicle": predict_detections,
    "all agents, 0.2 s late": lambda dataset, token: predict_detections(
        dataset, token, agents=None, link=Link(latency=0.2)
    ),
    "0.3 s late": lambda dataset, token: noisy(actors(dataset, token, -3)).detections(),
    "all are cars": changed(all_called([0] * 6)),
    "vans are trucks": changed(all_called([0, 1, 1, 3, 4, 5])),
    "trucks are vans": changed(all_called([0, 2, 2, 3, 4, 5])),
    "headings 15° off": changed(crooked),
    "no headings": changed(lambda found: replace(noisy(found), yaw=0 * noisy(found).yaw)),
    "front or rear by chance": changed(
        lambda found: replace(found, yaw=found.yaw + np.pi * (np.arange(len(found.yaw)) % 2))
    ),
    "no velocities": changed(moving(lambda velocity: 0 * velocity)),
    "one size": changed(of_sizes(lambda size: 0 * size + (4.5, 1.9, 1.6))),
    "small": changed(of_sizes(lambda size: 0.7 * size)),
    "scores by chance": changed(lambda found: replace(noisy(found), scores=np.sin(1e4 * noisy(found).scores))),
    "nothing": changed(lambda found: found.select(np.zeros(0, dtype=np.int64))),
    **{f"anywhere {seed}": changed(lambda found, seed=seed: noisy(found, 30, seed=seed)) for seed in (1, 2, 3)},
}


@pytest.mark.parametrize("detections", FINE)
def test_nothing_else_is_suspected(crossing: DeepAccident, moments: Moments, detections: str) -> None:
    assert suspected(crossing, moments, FINE[detections]) == []


@pytest.mark.parametrize("detections", FINE)
def test_boxes_without_twins_that_stand_are_fine(crossing: DeepAccident, moments: Moments, detections: str) -> None:
    warnings = box_warnings([{"boxes": box_counts(FINE[detections](crossing, token))} for token in moments])
    assert ["have a twin" in each for each in warnings] == [True] * (detections == "each one thrice")


def test_every_suspicion_is_tried() -> None:
    """Degrees and scores have tests of their own; the two frames of an agent differ too little with noise."""
    others = {
        *LAGS,
        *("lidar frame", "left-handed lidar frame", "scores the wrong way round"),
        *("heading in degrees", "heading in degrees in the world", "heading in degrees, or at random"),
    }
    assert {each.name for each in detection_suspicions()} == set(MISTAKES) | others


def test_the_lidar_frame_is_told_from_the_ego_frame_by_its_height(da_motion: DeepAccident, few: Moments) -> None:
    def detect(dataset: DeepAccident, token: str) -> DetectedBoxes:
        found = actors(dataset, token)
        lidar_from_world = dataset.world_from(token, "lidar").inverse()
        return replace(found, center=lidar_from_world.apply(found.center)).detections()

    assert suspected(da_motion, few, detect) == ["lidar frame"]


def test_the_first_sample_of_an_agent_has_no_truth_before_it(da_motion: DeepAccident) -> None:
    token = next(each["token"] for each in da_motion.sample[:] if each["token"].endswith("/ego_vehicle/001"))
    known = detection_moments(da_motion, token, detection_truth(da_motion, token))
    assert len(known.moved[-5]) == 0 < len(known.moved[5])
