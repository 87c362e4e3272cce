"""Motion labels and model outputs: FIERY-style maps of the bird's-eye view, and what is computed from them.

The way of a label, from a release to a model, and of a model's outputs to instances:

| step | from → to | where |
|---|---|---|
| what a sample shows | tables → `FrameBoxes`, ego motion | `sample_labels` (and `sample_lists`: which samples) |
| who is rasterised, and where | boxes → `FramePolygons` | `drawing.box_polygons` |
| which cells those are | polygons → cells | `drawing.polygon_fill` |
| ids, centres, flow | cells → centres here and at the next frame | `drawing.from_boxes` |
| maps | cells and centres → `MotionLabels` | `drawing.label_maps`, `labels` |
| all frames in the present ego frame | `MotionLabels` → the same, warped | `warps.to_present` |
| to another code, to disk | `MotionLabels` → batches; files | `batch_names`; `label_files` |
| a prediction | arrays → `MotionHeads` | `postprocessing.grouping` |
| instances of a frame | heads → centres, and cells by centre | `postprocessing.grouping` |
| the same id in all frames | instances → `LinkedInstances` | `postprocessing.grouping`, `postprocessing.predict` |
| boxes along the paths | linked instances → their redrawn maps | `postprocessing.contours` |

A `MotionLabelConfig` (`config`) says what is rasterised, a `LabelProtocol` how (`protocols`: every quirk of the
released code is a switch), and a grid's orientation how cells lie (`orientations`). `warps.to_present` also warps
a model's own maps as labels are warped.
"""

from deepaccident_devkit.motion.augmentation import Augmentation
from deepaccident_devkit.motion.batch_names import config_from_names
from deepaccident_devkit.motion.bev_segmentation import (
    BEV_CLASSES,
    BevSegmentation,
    bev_segmentation,
    segmentation_of,
)
from deepaccident_devkit.motion.config import PRESETS, MotionLabelConfig
from deepaccident_devkit.motion.drawing.box_polygons import OWN_BOX_ID, FrameBoxes, FramePolygons
from deepaccident_devkit.motion.drawing.from_boxes import labels_from_polygons, motion_labels_from_boxes
from deepaccident_devkit.motion.label_files import LabelFiles, LabelsWritten, write_label_files
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.postprocessing.grouping import MotionHeads
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
from deepaccident_devkit.motion.sample_lists import evaluation_samples, samples, training_samples
from deepaccident_devkit.motion.warps.to_present import agents_to_ego, past_to_present

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
    "evaluation_samples",
    "labels_from_polygons",
    "motion_labels",
    "motion_labels_from_boxes",
    "past_to_present",
    "predict_instances",
    "samples",
    "segmentation_of",
    "training_samples",
    "trajectories",
    "write_label_files",
]
