"""Compare every default and constant of motion with the values written out here."""

import numpy as np
from support.default_values import package_values
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import LabelFilesError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import (
    LabelFiles,
    MotionHeads,
    motion_labels_from_boxes,
    predict_instances,
    segmentation_of,
)
from deepaccident_devkit.release import BevImage
from deepaccident_devkit.taxonomy import BEV_SHAPE

WRITTEN = {
    "augmentation.Augmentation": "rotation=0.0, scale=1.0, flip=False",
    "batch_names.MAPS": "('segmentation', 'instance', 'centerness', 'offset', 'flow')",
    "batch_names.VECTOR_MAPS": "('offset', 'flow')",
    "batch_names.HEAD_NAMES": (
        "mappingproxy({'segmentation': 'segmentation', 'centerness': 'instance_center', "
        "'offset': 'instance_offset', 'flow': 'instance_flow'})"
    ),
    "bev_segmentation.BEV_CLASSES": "('road', 'lane_line', 'sidewalk', 'vehicle', 'pedestrian')",
    "bev_segmentation.COVERAGE": "{'road': 0.5, 'lane_line': 0.0, 'sidewalk': 0.5, 'vehicle': "
    "0.5, 'pedestrian': 0.0}",
    "bev_segmentation.bev_segmentation": "grid=None, augmentation=None",
    "bev_segmentation.cell_tags": "rule='majority'",
    "bev_segmentation.segmentation_of": "augmentation=None",
    "box_polygons.OWN_BOX_ID": "-101",
    "box_polygons.box_polygons": "is_vehicle=True",
    "config.LabelProtocol": "sight='released', pose='whole'",
    "config.MotionLabelConfig": (
        "grid=<factory>, receptive_field=3, future_frames=4, step=5, only_vehicle=False, "
        "filter_invisible=True, agents=None, draw_ego=True, ignore_index=255, orientation=None, "
        "sigma=3.0, protocol='released', augmentation=None"
    ),
    "drawing.motion_labels_from_boxes": "config=None, valid=None, is_vehicle=True, id_map=None",
    "drawing.labels_from_polygons": "config=None, valid=None, id_map=None",
    "grouping.LABEL_LOGIT": "10.0",
    "grouping.MotionHeads": "orientation='devkit', ignore_index=None",
    "grouping.MotionHeads.from_arrays": "orientation='devkit', ignore_index=None",
    "instances.FOREGROUND_THRESHOLD": "0.4",
    "instances.PostProcessing": (
        "foreground='argmax', labels_bypass_sigmoid=True, center_threshold=0.1, "
        "max_centers=100, "
        "scan='released', link_distance=10.0, redraw=False"
    ),
    "instances.predict_instances": "settings='motion'",
    "instances.trajectories": "protocol='released', half_cell_shift=None",
    "label_files.write_label_files": "config=None, names=None",
    "label_files.LabelFiles": "config=None",
    "label_folder.NO_CELL": "-32768",
    "label_folder.NO_ACTOR": "-9223372036854775808",
    "label_folder.LABEL_FORMAT": "'DeepAccident motion labels'",
    "label_folder.LABEL_FORMAT_VERSION": "1",
    "label_folder.MANIFEST": "'manifest.json'",
    "label_folder.LabelManifest": "names=None",
    "label_folder.LabelManifest.of": "names=None",
    "label_folder.LabelManifest.check": "names=None",
    "labels.MotionLabels": "at_present=False",
    "labels.MotionLabels.to_present": "centerness='nearest'",
    "labels.MotionLabels.from_batch": "at_present=False",
    "sample_labels.motion_labels": "config=None, id_map=None",
    "sample_labels.motion_labels_of": "config=None",
    "warping.present_from_frames": "augmentation=None",
    "warping.frames_from_next": "augmentation=None",
    "warping.present_from_past": "augmentation=None",
    "warping.ego_from_agents": "augmentation=None",
    "warping.nearest_indices": "orientation=None",
    "warping.rounded_points": "orientation=None",
    "warping.warp": "mode='nearest', fill=0, orientation=None",
    "warping.past_to_present": "grid=None, protocol='released', mode='nearest', augmentation=None",
    "warping.agents_to_ego": "grid=None, protocol='released', mode='nearest', augmentation=None",
}


def test_every_default_and_constant_written_out() -> None:
    assert package_values("deepaccident_devkit.motion") == WRITTEN

    labels = motion_labels_from_boxes([None] * 5, np.zeros((7, 6)))
    heads = MotionHeads.from_labels(labels.to_present())
    assert not predict_instances(heads).instance.any()
    assert not labels.as_batch("beverse")["motion_instance"].any()

    image = BevImage(np.zeros(BEV_SHAPE, dtype=np.uint8), np.zeros(BEV_SHAPE, dtype=np.uint16))
    targets = segmentation_of(image, BevGrid((-1, 1, 1), (-1, 1, 1)))
    assert not targets.masks.any()

    assert_raises(
        (lambda: LabelFiles("nowhere"), LabelFilesError, ("nowhere",)),
    )
