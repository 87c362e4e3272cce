"""Predictions without a model.

What a set of agents sees by the labels (`oracle`) goes on at a constant velocity or turn rate (`motion_models`,
`outlook`); `predict` makes motion maps (`drawing`), accidents (`collisions`) and detections of that, and
`predict_results` files of them.
"""

from deepaccident_devkit.baselines.motion_models import MotionModel, constant_turn_rate, constant_velocity
from deepaccident_devkit.baselines.oracle import SeenActors, seen_actors, turn_rates
from deepaccident_devkit.baselines.outlook import MOTION_MODELS, Outlook, outlook
from deepaccident_devkit.baselines.predict import predict_accidents, predict_detections, predict_motion
from deepaccident_devkit.baselines.predict_results import Baseline, predict_results

__all__ = [
    "MOTION_MODELS",
    "Baseline",
    "MotionModel",
    "Outlook",
    "SeenActors",
    "constant_turn_rate",
    "constant_velocity",
    "outlook",
    "predict_accidents",
    "predict_detections",
    "predict_motion",
    "predict_results",
    "seen_actors",
    "turn_rates",
]
