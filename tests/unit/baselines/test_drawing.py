from dataclasses import replace

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.baselines import SeenActors, seen_actors
from deepaccident_devkit.baselines.predict import label_times, motion_of
from deepaccident_devkit.evaluation import MotionEvaluator
from deepaccident_devkit.evaluation.motion import MOTION_PROTOCOLS
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabelConfig, MotionLabels
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.taxonomy import LIDAR, OWN_ACTOR_ID

CLEAN = MOTION_PROTOCOLS["released"].__class__(labels="clean")


def what_comes(da: DeepAccident, token: str, config: MotionLabelConfig) -> tuple[SeenActors, FloatArray]:
    """Whom the labels show at the present and all the time, and where they will be: (T, N, 3) in its ego frame."""
    seen = seen_actors(da, token, agents="all")
    scenario, agent, number = token.rsplit("/", 2)
    annotated = set(da.boxes(token, "ego").actor_id.tolist())
    poses = []
    for frame in range(config.label_frames):
        boxes = da.boxes(f"{scenario}/{agent}/{int(number) + frame * config.step:03d}", "world")
        boxes = boxes.transform(da.world_from(token, "ego").inverse(), "ego")
        annotated &= set(boxes.actor_id.tolist())
        poses.append(boxes)
    rows = np.flatnonzero(np.isin(seen.boxes.actor_id, list(annotated)))
    seen = SeenActors(boxes=seen.boxes.select(rows), seen_by=seen.seen_by[rows], own_actor_id=seen.own_actor_id)
    result = []
    for boxes in poses:
        place = [int(np.flatnonzero(boxes.actor_id == actor)[0]) for actor in seen.boxes.actor_id]
        result.append(np.column_stack([boxes.center[place, :2], boxes.yaw[place]]))
    return seen, np.stack(result)


def without_others(label: MotionLabels, known: set[int]) -> MotionLabels:
    """The label without those whose whole future the labels do not tell: they leave the range, or come into sight."""
    others = [number for actor, number in label.id_map.items() if actor not in {*known, OWN_BOX_ID}]
    gone = np.isin(label.instance, others)
    instance, segmentation = (np.where(gone, 0, each) for each in (label.instance, label.segmentation))
    return replace(label, instance=instance, segmentation=segmentation)


@pytest.mark.parametrize("agent", ["ego_vehicle", "other_vehicle_behind", "infrastructure"])
@pytest.mark.parametrize("protocol", ["released", "clean"])
def test_who_foresees_everything_scores_a_hundred(da_motion: DeepAccident, agent: str, protocol: str) -> None:
    """Cell by cell."""
    config = MotionLabelConfig(protocol=protocol)
    token = f"{da_motion.scenario[0]['token']}/{agent}/012"
    seen, poses = what_comes(da_motion, token, config)
    output = motion_of(seen, poses, da_motion.ego_from(token, LIDAR), config)
    evaluator = MotionEvaluator("released" if protocol == "released" else CLEAN)
    label = da_motion.motion_labels(token, config)
    evaluator.update(token, output, without_others(label, set(seen.boxes.actor_id.tolist())))
    result = evaluator.compute()
    assert len(seen.boxes) > 5
    for each in result.ranges.values():
        assert each.sq > 99.9
        assert (each.false_positive, each.false_negative) == (0, 0)
    assert result.ranges["100x100"].true_positive > 40


def test_the_present_is_drawn_exactly_as_labels_are(da_motion: DeepAccident) -> None:
    config = MotionLabelConfig()
    token = f"{da_motion.scenario[0]['token']}/ego_vehicle/012"
    label = da_motion.motion_labels(token)
    seen = seen_actors(da_motion, token, agents="all")
    rows = np.flatnonzero(np.isin(seen.boxes.actor_id, da_motion.boxes(token, "ego").actor_id))
    boxes = seen.boxes.select(rows)
    seen = SeenActors(boxes=boxes, seen_by=seen.seen_by[rows], own_actor_id=seen.own_actor_id)
    standing = np.repeat(np.column_stack([boxes.center[:, :2], boxes.yaw])[None], config.label_frames, axis=0)
    output = motion_of(seen, standing, da_motion.ego_from(token, LIDAR), config)
    assert output.instances is not None
    assert output.instances.shape == (1, 5, 200, 200)
    np.testing.assert_array_equal(output.instances[0, 0] > 0, label.instance[0] > 0)
    assert (output.instances[0] > 0).any(axis=(1, 2)).all()


def test_ids_stay_the_same_over_the_frames(da_motion: DeepAccident) -> None:
    config = MotionLabelConfig()
    token = f"{da_motion.scenario[0]['token']}/ego_vehicle/012"
    seen, poses = what_comes(da_motion, token, config)
    only = np.flatnonzero(seen.boxes.actor_id == OWN_ACTOR_ID)
    alone = SeenActors(boxes=seen.boxes.select(only), seen_by=seen.seen_by[only], own_actor_id=seen.own_actor_id)
    output = motion_of(alone, poses[:, only], da_motion.ego_from(token, LIDAR), config)
    assert output.instances is not None
    assert [np.unique(frame).tolist() for frame in output.instances[0]] == [[0, 1]] * 5


def test_label_times_are_the_label_frames() -> None:
    np.testing.assert_allclose(label_times(MotionLabelConfig()), [0, 0.5, 1, 1.5, 2])
    np.testing.assert_allclose(label_times(MotionLabelConfig(step=1, future_frames=3)), [0, 0.1, 0.2, 0.3])
