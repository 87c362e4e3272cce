"""How early an accident is warned of, and how often an alarm is false."""

from deepaccident_devkit.evaluation.warning.anticipation import (
    AnticipationFigures,
    AnticipationResult,
    CleanWarnings,
)
from deepaccident_devkit.evaluation.warning.clean import CleanScores, OperatingPoint
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
]
