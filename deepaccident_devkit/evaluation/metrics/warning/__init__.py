"""How early an accident is warned of, and how often an alarm is false."""

from deepaccident_devkit.evaluation.metrics.warning.anticipation import (
    AnticipationFigures,
    AnticipationResult,
    CleanWarnings,
)
from deepaccident_devkit.evaluation.metrics.warning.clean import CleanScores, OperatingPoint
from deepaccident_devkit.evaluation.metrics.warning.cost import AlarmCost, false_alarm_cost
from deepaccident_devkit.evaluation.metrics.warning.evaluator import WARNING_PROTOCOLS, WarningEvaluator
from deepaccident_devkit.evaluation.metrics.warning.field import (
    FieldFigures,
    FieldResult,
    FieldWarnings,
    field_figures,
    printed_figures,
)
from deepaccident_devkit.evaluation.metrics.warning.prevented import PreventedEvaluator
from deepaccident_devkit.evaluation.metrics.warning.prevention import (
    AccidentOutcomes,
    OutcomeTable,
    PreventedResult,
    PreventionCurve,
    PreventionFigures,
)
from deepaccident_devkit.evaluation.metrics.warning.series import ScoreSeries

__all__ = [
    "WARNING_PROTOCOLS",
    "AccidentOutcomes",
    "AlarmCost",
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
    "false_alarm_cost",
    "field_figures",
    "printed_figures",
]
