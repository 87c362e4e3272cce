"""Motion labels and model outputs: FIERY-style maps of the bird's-eye view, and their instances.

The steps from a release to a model's training labels, and from a model's outputs to instances:

| step | from → to | module |
|---|---|---|
| samples and their boxes | tables → `BoxRows`, ego motion | `sample_labels` |
| rasterised actors | boxes → `Polygons` → `Footprints` | `box_polygons` |
| ids, centres, flow | footprints → centres, also at the next frame | `drawing` |
| maps | centres and cells → `MotionLabels` | `drawing`, `labels` |
| all frames in the present ego frame | `MotionLabels` → the same, warped | `labels`, `warping` |
| to another code base, to disk | `MotionLabels` → batches; files | `batch_names`; `label_files` |
| a prediction, and instances of a frame | arrays → `MotionHeads` → cells by centre | `grouping` |
| the same id in all frames | instances → `LinkedInstances` | `instances` |
| boxes along the paths | linked instances → their redrawn maps | `instances` |

`reference_arithmetic` reproduces the arithmetic that other libraries use in these steps. A
`MotionLabelConfig` decides what is rasterised, and a `LabelProtocol` how; both are in `config`, and
every quirk of the released code is an option. A grid's orientation decides how its cells are stored
in arrays (`geometry.bev_grid`). `warping` also warps a model's feature maps as it warps labels.
"""

from deepaccident_devkit.motion.augmentation import Augmentation
from deepaccident_devkit.motion.batch_names import config_from_names
from deepaccident_devkit.motion.bev_segmentation import (
    BEV_CLASSES,
    BevSegmentation,
    TagRule,
    bev_segmentation,
    cell_tags,
    segmentation_of,
)
from deepaccident_devkit.motion.box_polygons import OWN_BOX_ID, FrameBoxes, FramePolygons
from deepaccident_devkit.motion.config import (
    LABEL_PROTOCOLS,
    PRESETS,
    LabelProtocol,
    MotionLabelConfig,
)
from deepaccident_devkit.motion.drawing import labels_from_polygons, motion_labels_from_boxes
from deepaccident_devkit.motion.grouping import MotionHeads
from deepaccident_devkit.motion.instances import (
    POST_PROCESSING,
    InstancePath,
    LinkedInstances,
    PostProcessing,
    predict_instances,
    trajectories,
)
from deepaccident_devkit.motion.label_files import LabelFiles, LabelsWritten, write_label_files
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.sample_labels import motion_labels, motion_labels_of
from deepaccident_devkit.motion.warping import agents_to_ego, past_to_present

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
    "TagRule",
    "agents_to_ego",
    "bev_segmentation",
    "cell_tags",
    "config_from_names",
    "labels_from_polygons",
    "motion_labels",
    "motion_labels_from_boxes",
    "motion_labels_of",
    "past_to_present",
    "predict_instances",
    "segmentation_of",
    "trajectories",
    "write_label_files",
]
