"""How early an accident is warned of, and how often an alarm is false."""

from deepaccident_devkit.evaluation.warning.anticipation import AnticipationFigures, AnticipationResult, CleanWarnings
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
from deepaccident_devkit.rooms import names_of

__all__ = [
    "WARNING_PROTOCOLS",
    "AccidentOutcomes",
    "AnticipationFigures",
    "AnticipationResult",
    "CleanScores",
    "CleanWarnings",
    "FieldFigures",
    "FieldResult",
    "FieldWarnings",
    "OperatingPoint",
    "OutcomeTable",
    "PreventedEvaluator",
    "PreventedResult",
    "PreventionCurve",
    "PreventionFigures",
    "ScoreSeries",
    "WarningEvaluator",
    "field_figures",
    "printed_figures",
]

__getattr__, __dir__ = names_of(__name__, __all__)  # what the room `safety` adds
