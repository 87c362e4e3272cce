"""The golden labels (tests/data/golden, a_labels): whole samples, in each frame's own ego frame,
augmented ones too.

Made by the released transforms under numpy 1.23.5, OpenCV 4.7.0 and torch 2.13 on a processor
(tests/data/golden/README.md). Every cell of segmentation, instance, offset and flow is equal, and
centerness after rounding to float16, as it is stored (one cell in three million flips in rounding);
boxes within 1e-5 m.
"""

import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit.geometry.bev_grid import to_orientation
from deepaccident_devkit.geometry.conventions import flip_points, flip_pose, flip_six_vector
from deepaccident_devkit.motion import (
    OWN_BOX_ID,
    Augmentation,
    FrameBoxes,
    MotionLabelConfig,
    MotionLabels,
    motion_labels_from_boxes,
)
from deepaccident_devkit.motion.box_polygons import box_polygons
from deepaccident_devkit.tables import visible_ids, visible_mask
from deepaccident_devkit.taxonomy import AGENTS, INFRASTRUCTURE

pytestmark = pytest.mark.golden_cases("a_labels", "scenes")
LABEL_FRAMES, PRESENT = 5, 2
BOX_TOLERANCE = 1e-5
FLIPS = 1
"""Cells of a scene's million whose float16 rounding may flip."""


class Scene:
    """One scene's own file: `scene["vis_xy", 3, 0]` is its array `vis_xy_3_0`."""

    def __init__(self, golden) -> None:
        self.entry: dict[str, Any] = golden.entry
        self._arrays = _arrays(golden.folder / f"a_labels_{golden.index:02d}.npz")

    def __getitem__(self, name: str | tuple[str | int, ...]) -> np.ndarray:
        return self._arrays[_joined(name)]

    def has(self, *name: str | int) -> bool:
        return _joined(name) in self._arrays


@functools.lru_cache(maxsize=2)
def _arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as archive:
        return dict(archive)


def _joined(name: str | tuple[str | int, ...]) -> str:
    return name if isinstance(name, str) else "_".join(map(str, name))


def frames_of(scene) -> list[FrameBoxes | None]:
    """The scene's boxes at the label frames, right-handed, with what the five agents see by our own
    rule.
    """
    return [_frame_of(scene, t) if scene.has("boxes", t) else None for t in range(LABEL_FRAMES)]


def _frame_of(scene, t: int) -> FrameBoxes:
    boxes = scene["boxes", t]
    seen = visible_ids(
        [
            visible_mask(
                *(scene[f"vis_{name}", t, a] for name in ("xy", "cls", "pts")),
                scene["vis_cam", t, a] > 0,
                infrastructure=agent == INFRASTRUCTURE,
            )
            for a, agent in enumerate(AGENTS)
        ],
        [scene["vis_ids", t, a] for a in range(len(AGENTS))],
    )
    return FrameBoxes(
        center=flip_points(boxes[:, :3]),
        size=boxes[:, 3:6],
        yaw=boxes[:, 6],
        actor_id=scene["ids", t],
        category=scene["cls", t],
        visible=np.isin(scene["ids", t], seen),
        ego_from_lidar=flip_pose(scene["l2e", t + PRESENT]),
    )


def augmentation_of(scene) -> Augmentation | None:
    """The released left-handed matrix, flip · scale · rotation, taken apart."""
    if not scene.has("aug_transform"):
        return None
    matrix = flip_pose(scene["aug_transform"])
    flip = np.linalg.det(matrix[:3, :3]) < 0
    scale = np.linalg.norm(matrix[0, :3])
    turned = matrix[:2, :2] / scale * [[1], [-1 if flip else 1]]
    return Augmentation(rotation=np.arctan2(turned[1, 0], turned[0, 0]), scale=scale, flip=flip)


def config_of(scene, **changes) -> MotionLabelConfig:
    return MotionLabelConfig(
        **{"orientation": "released", "augmentation": augmentation_of(scene), **changes}
    )


def labels_of(scene, **changes) -> MotionLabels:
    motion = flip_six_vector(scene["future_egomotions"])
    is_vehicle = scene.entry["agent"] != INFRASTRUCTURE
    return motion_labels_from_boxes(
        frames_of(scene), motion, config_of(scene, **changes), is_vehicle=is_vehicle
    )


def test_who_is_seen_equals_the_released_codes(golden) -> None:
    scene = Scene(golden)
    for t, frame in enumerate(frames_of(scene)):
        if frame is not None:
            assert_array_equal(3 * frame.visible + 1, scene["out_vis", t])


def test_corners_of_boxes_equal_the_released_codes(golden) -> None:
    scene = Scene(golden)
    frames = frames_of(scene)
    drawn = box_polygons(
        frames, config_of(scene), is_vehicle=scene.entry["agent"] != INFRASTRUCTURE
    )
    every = box_polygons(frames, config_of(scene, filter_invisible=False), is_vehicle=False)
    for t, frame in enumerate(frames):
        if frame is None:
            assert (drawn[t], every[t]) == (None, None)
            continue
        is_own = drawn[t].key == OWN_BOX_ID
        own = flip(scene["out_egocorners", t])
        assert_allclose(drawn[t].corners[is_own], own, rtol=0, atol=BOX_TOLERANCE)
        others = flip(scene["out_corners", t])
        seen_first = scene["ids", 0][scene["out_vis", 0] != 1]
        kept = np.isin(scene["ids", t], seen_first)
        assert_array_equal(drawn[t].key[~is_own], scene["ids", t][kept])
        assert_allclose(drawn[t].corners[~is_own], others[kept], rtol=0, atol=BOX_TOLERANCE)
        assert_allclose(
            every[t].corners, others[scene["ids", t] != -100], rtol=0, atol=BOX_TOLERANCE
        )


def flip(corners: np.ndarray) -> np.ndarray:
    """Corners (n, 4, 2) of one handedness in the other."""
    return corners * np.float32([1, -1])


def test_labels_equal_the_released_codes(golden) -> None:
    scene = Scene(golden)
    labels = labels_of(scene)
    differing = {
        name: int((getattr(labels, name) != scene[name]).sum())
        for name in ("segmentation", "instance", "offset", "flow")
    }
    assert differing == {"segmentation": 0, "instance": 0, "offset": 0, "flow": 0}
    assert (labels.centerness.astype(np.float16) != scene["centerness"]).sum() <= FLIPS
    assert {str(key): value for key, value in labels.id_map.items()} == scene.entry["instance_map"]
    assert_array_equal(labels.label_valid, scene["frame_valid"])


@pytest.mark.parametrize("orientation", ["devkit", "fiery"])
def test_other_orientations_hold_the_same_cells(golden, orientation) -> None:
    scene = Scene(golden)
    released, other = labels_of(scene), labels_of(scene, orientation=orientation)
    for name in ("segmentation", "instance", "centerness", "offset", "flow"):
        expected = to_orientation(
            getattr(released, name),
            vectors=name in ("offset", "flow"),
            source="released",
            target=orientation,
            ignore=released.config.ignore_index,
        )
        assert_array_equal(getattr(other, name), expected)
        assert getattr(other, name).flags.c_contiguous
