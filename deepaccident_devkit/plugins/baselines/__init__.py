"""Predictions without a model.

The actors that a set of agents sees by the labels continue at a constant velocity or turn rate, or
stand still (`outlook`). `predict` turns them into motion maps, accidents, detections and paths, and
`predict_results` writes files of these.
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
