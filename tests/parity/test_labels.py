"""The golden labels (tests/data/golden, a_labels): whole samples, in each frame's own ego frame,
augmented ones too.

The released transforms made them under numpy 1.23.5, OpenCV 4.7.0 and torch 2.13 on the CPU
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
from parity.test_warps import make_augmentation

from deepaccident_devkit.geometry.bev_grid import to_orientation
from deepaccident_devkit.geometry.conventions import flip_points, flip_pose, flip_six_vector
from deepaccident_devkit.motion import (
    OWN_BOX_ID,
    FrameBoxes,
    MotionLabelConfig,
    MotionLabels,
    motion_labels_from_boxes,
)
from deepaccident_devkit.motion.box_polygons import box_polygons
from deepaccident_devkit.tables import visible_ids, visible_mask
from deepaccident_devkit.taxonomy import AGENTS, INFRASTRUCTURE

pytestmark = pytest.mark.golden_cases("a_labels", "scenes")
LABEL_FRAMES = 5
PRESENT = 2
BOX_TOLERANCE_M = 1e-5
MAX_FLIPPED_CELLS = 1
"""The cells of a scene's million that may differ, since rounding to float16 may flip them."""


class Scene:
    """The arrays in one scene's file: `scene["vis_xy", 3, 0]` is its array `vis_xy_3_0`."""

    def __init__(self, golden) -> None:
        self.entry: dict[str, Any] = golden.entry
        self._arrays = _read_arrays(golden.folder / f"a_labels_{golden.index:02d}.npz")

    def __getitem__(self, name: str | tuple[str | int, ...]) -> np.ndarray:
        return self._arrays[_joined(name)]

    def has(self, *name: str | int) -> bool:
        return _joined(name) in self._arrays


@functools.lru_cache(maxsize=2)
def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as archive:
        return dict(archive)


def _joined(name: str | tuple[str | int, ...]) -> str:
    if isinstance(name, str):
        return name
    return "_".join(map(str, name))


def read_frames(scene) -> list[FrameBoxes | None]:
    """Return the scene's right-handed boxes at the label frames.

    Our own rule decides which boxes the five agents see.
    """
    return [_read_frame(scene, t) if scene.has("boxes", t) else None for t in range(LABEL_FRAMES)]


def _read_frame(scene, t: int) -> FrameBoxes:
    boxes = scene["boxes", t]
    masks = [
        visible_mask(
            scene["vis_xy", t, number],
            scene["vis_cls", t, number],
            scene["vis_pts", t, number],
            scene["vis_cam", t, number] > 0,
            infrastructure=agent == INFRASTRUCTURE,
        )
        for number, agent in enumerate(AGENTS)
    ]
    ids_by_agent = [scene["vis_ids", t, number] for number in range(len(AGENTS))]
    seen_ids = visible_ids(masks, ids_by_agent)
    return FrameBoxes(
        center=flip_points(boxes[:, :3]),
        size=boxes[:, 3:6],
        yaw=boxes[:, 6],
        actor_id=scene["ids", t],
        category=scene["cls", t],
        visible=np.isin(scene["ids", t], seen_ids),
        ego_from_lidar=flip_pose(scene["l2e", t + PRESENT]),
    )


def make_config(scene, **changes) -> MotionLabelConfig:
    matrix = scene["aug_transform"] if scene.has("aug_transform") else None
    augmentation = make_augmentation(matrix)
    options = {"orientation": "released", "augmentation": augmentation}
    return MotionLabelConfig(**(options | changes))


def make_labels(scene, **changes) -> MotionLabels:
    frames = read_frames(scene)
    motion = flip_six_vector(scene["future_egomotions"])
    config = make_config(scene, **changes)
    is_vehicle = scene.entry["agent"] != INFRASTRUCTURE
    return motion_labels_from_boxes(frames, motion, config, is_vehicle=is_vehicle)


def test_visible_boxes_equal_the_released_codes(golden) -> None:
    scene = Scene(golden)
    for t, frame in enumerate(read_frames(scene)):
        if frame is not None:
            assert_array_equal(3 * frame.visible + 1, scene["out_vis", t])


def test_corners_of_boxes_equal_the_released_codes(golden) -> None:
    scene = Scene(golden)
    frames = read_frames(scene)
    is_vehicle = scene.entry["agent"] != INFRASTRUCTURE
    config_of_all = make_config(scene, filter_invisible=False)
    visible_polygons = box_polygons(frames, make_config(scene), is_vehicle=is_vehicle)
    all_polygons = box_polygons(frames, config_of_all, is_vehicle=False)

    for t, frame in enumerate(frames):
        drawn = visible_polygons[t]
        if frame is None:
            assert drawn is None
            assert all_polygons[t] is None
            continue
        is_own = drawn.key == OWN_BOX_ID
        own_corners = flip(scene["out_egocorners", t])
        assert_allclose(drawn.corners[is_own], own_corners, rtol=0, atol=BOX_TOLERANCE_M)

        ids = scene["ids", t]
        corners = flip(scene["out_corners", t])
        seen_first = scene["ids", 0][scene["out_vis", 0] != 1]
        is_seen = np.isin(ids, seen_first)
        assert_array_equal(drawn.key[~is_own], ids[is_seen])
        assert_allclose(drawn.corners[~is_own], corners[is_seen], rtol=0, atol=BOX_TOLERANCE_M)
        assert_allclose(all_polygons[t].corners, corners[ids != -100], rtol=0, atol=BOX_TOLERANCE_M)


def flip(corners: np.ndarray) -> np.ndarray:
    """Convert corners (n, 4, 2) from one handedness to the other."""
    return corners * np.float32([1, -1])


def test_labels_equal_the_released_codes(golden) -> None:
    scene = Scene(golden)
    labels = make_labels(scene)
    for name in ("segmentation", "instance", "offset", "flow"):
        differing_cells = getattr(labels, name) != scene[name]
        assert differing_cells.sum() == 0, name
    flipped_cells = labels.centerness.astype(np.float16) != scene["centerness"]
    assert flipped_cells.sum() <= MAX_FLIPPED_CELLS
    id_map = {str(key): value for key, value in labels.id_map.items()}
    assert id_map == scene.entry["instance_map"]
    assert_array_equal(labels.label_valid, scene["frame_valid"])


@pytest.mark.parametrize("orientation", ["devkit", "fiery"])
def test_other_orientations_hold_the_same_cells(golden, orientation) -> None:
    scene = Scene(golden)
    released_labels = make_labels(scene)
    labels = make_labels(scene, orientation=orientation)
    for name in ("segmentation", "instance", "centerness", "offset", "flow"):
        expected = to_orientation(
            getattr(released_labels, name),
            vectors=name in ("offset", "flow"),
            source="released",
            target=orientation,
            ignore=released_labels.config.ignore_index,
        )
        values = getattr(labels, name)
        assert_array_equal(values, expected)
        assert values.flags.c_contiguous
