"""Warnings: how early they precede an accident, and how often an alarm is false."""

from deepaccident_devkit.evaluation.warning.anticipation import (
    AnticipationFigures,
    AnticipationResult,
    CleanWarnings,
)
from deepaccident_devkit.evaluation.warning.clean import CleanScores, OperatingPoint, roc_area
from deepaccident_devkit.evaluation.warning.evaluator import WARNING_PROTOCOLS, WarningEvaluator
from deepaccident_devkit.evaluation.warning.field import (
    FieldFigures,
    FieldResult,
    FieldWarnings,
    field_figures,
    printed_figures,
)
from deepaccident_devkit.evaluation.warning.recordings import ScoreSeries

__all__ = [
    "WARNING_PROTOCOLS",
    "AnticipationFigures",
    "AnticipationResult",
    "CleanScores",
    "CleanWarnings",
    "FieldFigures",
    "FieldResult",
    "FieldWarnings",
    "OperatingPoint",
    "ScoreSeries",
    "WarningEvaluator",
    "field_figures",
    "printed_figures",
    "roc_area",
]
