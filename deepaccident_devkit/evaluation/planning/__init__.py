"""Planned paths: the definitions of UniAD, ST-P3, VAD and BEV-Planner, and `clean`, which is for accidents."""

from deepaccident_devkit.evaluation.planning.cells import CELL_PROTOCOLS, CellRules
from deepaccident_devkit.evaluation.planning.clean import CleanPlanning
from deepaccident_devkit.evaluation.planning.evaluator import (
    PLANNING_PROTOCOLS,
    PlanningEvaluator,
    PlanningResult,
)
from deepaccident_devkit.evaluation.planning.scene import (
    Plan,
    PlanningScene,
    planning_scene,
    trivial_plans,
)

__all__ = [
    "CELL_PROTOCOLS",
    "PLANNING_PROTOCOLS",
    "CellRules",
    "CleanPlanning",
    "Plan",
    "PlanningEvaluator",
    "PlanningResult",
    "PlanningScene",
    "planning_scene",
    "trivial_plans",
]
