"""How well accidents are foreseen, by three protocols."""

from deepaccident_devkit.evaluation.accident.boxes import BoxAccidents
from deepaccident_devkit.evaluation.accident.compared import ComparedAccidents, compared_accidents
from deepaccident_devkit.evaluation.accident.context import accident_context
from deepaccident_devkit.evaluation.accident.evaluator import PROTOCOLS, AccidentEvaluator
from deepaccident_devkit.evaluation.accident.impact import BoxTruth, box_truth
from deepaccident_devkit.evaluation.accident.instance_accidents import accidents_of
from deepaccident_devkit.evaluation.accident.paper import PaperAccidents
from deepaccident_devkit.evaluation.accident.protocol import AccidentContext, AccidentProtocol, Prediction
from deepaccident_devkit.evaluation.accident.reading import AccidentReading
from deepaccident_devkit.evaluation.accident.released import ReleasedAccidents
from deepaccident_devkit.evaluation.accident.result import DISTANCES, AccidentResult, AccidentsWithin

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
    "accidents_of",
    "box_truth",
    "compared_accidents",
]
