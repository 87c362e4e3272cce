"""Checks for what is wrong, odd or missing in a release, across agents and files."""

from deepaccident_devkit.tables import Finding
from deepaccident_devkit.tables.boxes import VelocityFit
from deepaccident_devkit.validation.codes import CODES
from deepaccident_devkit.validation.completeness import (
    Completeness,
    FileCount,
    SplitFiles,
    release_completeness,
)
from deepaccident_devkit.validation.croissant import data_card
from deepaccident_devkit.validation.validate import (
    ScenarioCheck,
    ValidationReport,
    findings,
    validate_release,
)

__all__ = [
    "CODES",
    "Completeness",
    "FileCount",
    "Finding",
    "ScenarioCheck",
    "SplitFiles",
    "ValidationReport",
    "VelocityFit",
    "data_card",
    "findings",
    "release_completeness",
    "validate_release",
]
