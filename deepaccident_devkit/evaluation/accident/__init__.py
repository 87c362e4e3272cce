"""How well accidents are foreseen, by three protocols."""

from deepaccident_devkit.evaluation.accident.box_truth import accident_context
from deepaccident_devkit.evaluation.accident.boxes import BoxAccidents
from deepaccident_devkit.evaluation.accident.evaluator import PROTOCOLS, AccidentEvaluator
from deepaccident_devkit.evaluation.accident.paper import PaperAccidents
from deepaccident_devkit.evaluation.accident.protocol import AccidentContext, AccidentProtocol, Prediction
from deepaccident_devkit.evaluation.accident.released import ReleasedAccidents
from deepaccident_devkit.evaluation.accident.result import DISTANCES, AccidentResult, AccidentsWithin

__all__ = [
    "DISTANCES",
    "PROTOCOLS",
    "AccidentContext",
    "AccidentEvaluator",
    "AccidentProtocol",
    "AccidentResult",
    "AccidentsWithin",
    "BoxAccidents",
    "PaperAccidents",
    "Prediction",
    "ReleasedAccidents",
    "accident_context",
]
