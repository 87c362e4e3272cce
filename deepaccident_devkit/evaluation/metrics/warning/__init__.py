"""How early an accident is warned of, and how often an alarm is false."""

from deepaccident_devkit.evaluation.metrics.warning.evaluator import WARNING_PROTOCOLS, WarningEvaluator
from deepaccident_devkit.evaluation.metrics.warning.protocol import WarningProtocol
from deepaccident_devkit.evaluation.metrics.warning.result import WarningCurve, WarningResult

__all__ = ["WARNING_PROTOCOLS", "WarningCurve", "WarningEvaluator", "WarningProtocol", "WarningResult"]
