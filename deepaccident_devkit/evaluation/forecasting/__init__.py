"""Predicted paths of other actors, compared with the recorded ones: the task `forecasting`."""

from deepaccident_devkit.evaluation.forecasting.evaluator import (
    FORECASTING_PROTOCOLS,
    ForecastingEvaluator,
    ForecastingProtocol,
    ForecastingResult,
)
from deepaccident_devkit.evaluation.forecasting.metrics import (
    Forecast,
    displacement_errors,
    miss_rate,
)
from deepaccident_devkit.evaluation.forecasting.of_motion import forecasts_of
from deepaccident_devkit.evaluation.forecasting.truth import ForecastingTruth, forecasting_truth

__all__ = [
    "FORECASTING_PROTOCOLS",
    "Forecast",
    "ForecastingEvaluator",
    "ForecastingProtocol",
    "ForecastingResult",
    "ForecastingTruth",
    "displacement_errors",
    "forecasting_truth",
    "forecasts_of",
    "miss_rate",
]
