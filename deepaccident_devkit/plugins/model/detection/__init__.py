"""Detection: boxes as peaks on the ground (CenterPoint), with the released quirks as settings."""

from deepaccident_devkit.plugins.model.detection.decoding import (
    RELEASED_NMS,
    Candidates,
    DecodingConfig,
    Detections,
    NmsConfig,
    decode_candidates,
    decode_detections,
    detected_boxes,
    rotated_iou,
    suppress,
)
from deepaccident_devkit.plugins.model.detection.head import (
    CLASS_SLOTS,
    ONE_TASK,
    RELEASED_CLASS_SLOTS,
    CenterHead,
    DetectionConfig,
    TaskMaps,
)
from deepaccident_devkit.plugins.model.detection.targets import (
    DetectionLossConfig,
    TargetConfig,
    TaskTargets,
    detection_losses,
    detection_targets,
)

__all__ = [
    "CLASS_SLOTS",
    "ONE_TASK",
    "RELEASED_CLASS_SLOTS",
    "RELEASED_NMS",
    "Candidates",
    "CenterHead",
    "DecodingConfig",
    "DetectionConfig",
    "DetectionLossConfig",
    "Detections",
    "NmsConfig",
    "TargetConfig",
    "TaskMaps",
    "TaskTargets",
    "decode_candidates",
    "decode_detections",
    "detected_boxes",
    "detection_losses",
    "detection_targets",
    "rotated_iou",
    "suppress",
]
