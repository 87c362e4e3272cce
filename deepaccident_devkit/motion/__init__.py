"""Motion labels and model outputs: FIERY-style maps of the bird's-eye view, and what is read off them."""

from deepaccident_devkit.motion.augmentation import Augmentation
from deepaccident_devkit.motion.bev_segmentation import (
    BEV_CLASSES,
    BevSegmentation,
    bev_segmentation,
    segmentation_of,
)
from deepaccident_devkit.motion.config import PRESETS, MotionLabelConfig
from deepaccident_devkit.motion.drawing.from_boxes import (
    FrameBoxes,
    FramePolygons,
    labels_from_polygons,
    motion_labels_from_boxes,
)
from deepaccident_devkit.motion.label_files import LabelFiles, LabelsWritten, write_label_files
from deepaccident_devkit.motion.labels import OWN_BOX_ID, MotionLabels
from deepaccident_devkit.motion.names import config_from_names
from deepaccident_devkit.motion.postprocessing.heads import MotionHeads
from deepaccident_devkit.motion.postprocessing.predict import (
    POST_PROCESSING,
    InstancePath,
    LinkedInstances,
    PostProcessing,
    predict_instances,
    trajectories,
)
from deepaccident_devkit.motion.protocols import LABEL_PROTOCOLS, LabelProtocol
from deepaccident_devkit.motion.sample_labels import motion_labels
from deepaccident_devkit.motion.sample_lists import samples
from deepaccident_devkit.motion.warps.feature_warps import agents_to_ego, past_to_present

__all__ = [
    "BEV_CLASSES",
    "LABEL_PROTOCOLS",
    "OWN_BOX_ID",
    "POST_PROCESSING",
    "PRESETS",
    "Augmentation",
    "BevSegmentation",
    "FrameBoxes",
    "FramePolygons",
    "InstancePath",
    "LabelFiles",
    "LabelProtocol",
    "LabelsWritten",
    "LinkedInstances",
    "MotionHeads",
    "MotionLabelConfig",
    "MotionLabels",
    "PostProcessing",
    "agents_to_ego",
    "bev_segmentation",
    "config_from_names",
    "labels_from_polygons",
    "motion_labels",
    "motion_labels_from_boxes",
    "past_to_present",
    "predict_instances",
    "samples",
    "segmentation_of",
    "trajectories",
    "write_label_files",
]
