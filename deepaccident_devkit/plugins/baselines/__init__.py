"""Predictions without a model.

What a set of agents sees by the labels goes on at a constant velocity or turn rate, or stands (`outlook`); `predict`
makes motion maps, accidents (`collisions`), detections and paths of that, and `predict_results` files of them.
"""

from deepaccident_devkit.plugins.baselines.outlook import (
    MOTION_MODELS,
    MotionModel,
    Outlook,
    constant_turn_rate,
    constant_velocity,
    outlook,
    turn_rates,
)
from deepaccident_devkit.plugins.baselines.predict import (
    detected_accidents,
    predict_accidents,
    predict_detections,
    predict_forecasts,
    predict_motion,
    predict_plan,
)
from deepaccident_devkit.plugins.baselines.predict_results import Baseline, predict_results
from deepaccident_devkit.v2x.cooperation import SeenActors, seen_actors

__all__ = [
    "MOTION_MODELS",
    "Baseline",
    "MotionModel",
    "Outlook",
    "SeenActors",
    "constant_turn_rate",
    "constant_velocity",
    "detected_accidents",
    "outlook",
    "predict_accidents",
    "predict_detections",
    "predict_forecasts",
    "predict_motion",
    "predict_plan",
    "predict_results",
    "seen_actors",
    "turn_rates",
]
