"""What is wrong, odd or missing in a release, checked across agents and files."""

from deepaccident_devkit.tables import Finding
from deepaccident_devkit.tables.velocities import VelocityFit
from deepaccident_devkit.validation.checks import ScenarioCheck
from deepaccident_devkit.validation.codes import CODES
from deepaccident_devkit.validation.report import Coverage, ValidationReport
from deepaccident_devkit.validation.validate import findings, merged_validation, validate_release, validation_shard

__all__ = [
    "CODES",
    "Coverage",
    "Finding",
    "ScenarioCheck",
    "ValidationReport",
    "VelocityFit",
    "findings",
    "merged_validation",
    "validate_release",
    "validation_shard",
]
