"""How well accidents are foreseen, by three protocols."""

from deepaccident_devkit.evaluation.accident.boxes import BoxAccidents
from deepaccident_devkit.evaluation.accident.evaluator import (
    PROTOCOLS,
    AccidentEvaluator,
    AccidentProtocol,
    ComparedAccidents,
    compared_accidents,
)
from deepaccident_devkit.evaluation.accident.paper import PaperAccidents
from deepaccident_devkit.evaluation.accident.released import ReleasedAccidents
from deepaccident_devkit.evaluation.accident.scoring import DISTANCES, AccidentResult, AccidentsWithin
from deepaccident_devkit.evaluation.accident_truth import (
    AccidentContext,
    BoxTruth,
    accident_context,
    box_truth,
    foreseen_accident,
)
from deepaccident_devkit.evaluation.map_accidents import AccidentReading
from deepaccident_devkit.evaluation.predictions import Prediction

__all__ = [
    "DISTANCES",
    "PROTOCOLS",
    "AccidentContext",
    "AccidentEvaluator",
    "AccidentProtocol",
    "AccidentReading",
    "AccidentResult",
    "AccidentsWithin",
    "BoxAccidents",
    "BoxTruth",
    "ComparedAccidents",
    "PaperAccidents",
    "Prediction",
    "ReleasedAccidents",
    "accident_context",
    "box_truth",
    "compared_accidents",
    "foreseen_accident",
]
