"""Predictions without a model, and how much cooperation improves them.

What a set of agents sees by the labels (`oracle`) goes on at a constant velocity or turn rate (`motion_models`,
`outlook`); `predict` makes motion maps (`drawing`), accidents (`collisions`) and detections of that, `predict_results`
files of them, and `study` the paper's tables on V2X.
"""

from deepaccident_devkit.baselines.hidden_collider import HiddenCollider, demo_table
from deepaccident_devkit.baselines.motion_models import MotionModel, constant_turn_rate, constant_velocity
from deepaccident_devkit.baselines.oracle import SeenActors, seen_actors, turn_rates
from deepaccident_devkit.baselines.outlook import MOTION_MODELS, Outlook, outlook
from deepaccident_devkit.baselines.predict import predict_accidents, predict_detections, predict_motion
from deepaccident_devkit.baselines.predict_results import Baseline, predict_results
from deepaccident_devkit.baselines.study import v2x_study
from deepaccident_devkit.baselines.study_config import StudyConfig
from deepaccident_devkit.baselines.study_result import METRICS, StudyRow, StudyTable, V2XStudy

__all__ = [
    "METRICS",
    "MOTION_MODELS",
    "Baseline",
    "HiddenCollider",
    "MotionModel",
    "Outlook",
    "SeenActors",
    "StudyConfig",
    "StudyRow",
    "StudyTable",
    "V2XStudy",
    "constant_turn_rate",
    "constant_velocity",
    "demo_table",
    "outlook",
    "predict_accidents",
    "predict_detections",
    "predict_motion",
    "predict_results",
    "seen_actors",
    "turn_rates",
    "v2x_study",
]
