"""Predictions without a trained model.

The actors that some agents see according to the labels continue at a constant velocity or turn
rate, or stand still (`outlook`). `predict` turns this into motion maps, accidents, detections and
paths; `predict_results` writes them to results files.
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
    predict_tracks,
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
    "predict_tracks",
    "seen_actors",
    "turn_rates",
]
