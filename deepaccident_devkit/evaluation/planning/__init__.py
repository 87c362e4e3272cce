"""Planned paths (task `planning`): rules of UniAD, ST-P3, VAD, BEV-Planner, and our own `clean`."""

from deepaccident_devkit.evaluation.planning.cells import (
    CELL_PROTOCOLS,
    CellRules,
    collision_rate,
    plan_displacement_errors,
)
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
    "collision_rate",
    "plan_displacement_errors",
    "planning_scene",
    "trivial_plans",
]
