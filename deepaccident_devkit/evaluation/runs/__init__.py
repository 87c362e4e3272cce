"""Whole evaluations: from a results file to a bundle of numbers that others can check and compare.

`evaluate_results` computes an `EvaluationRun`, `save_run` writes it as a bundle, `verify_bundle`
repeats it, and `compare_bundles` decides which differences between two bundles are real.
"""

from deepaccident_devkit.evaluation.runs.bundles import (
    Bundle,
    checked_target,
    read_bundle,
    save_run,
)
from deepaccident_devkit.evaluation.runs.comparison import (
    ComparedNumber,
    Comparison,
    compare_bundles,
)
from deepaccident_devkit.evaluation.runs.evaluation_run import (
    BREAKDOWNS,
    EvaluationRun,
    Partial,
    ReleaseInfo,
    ResultsInfo,
    breakdowns_of,
    evaluate_results,
)
from deepaccident_devkit.evaluation.runs.over_bytes import BytesPoint, OverBytes, over_bytes
from deepaccident_devkit.evaluation.runs.rows import read_rows, sample_rows
from deepaccident_devkit.evaluation.runs.setups import (
    Coverage,
    SampleSelection,
    coverage,
    default_selection,
    evaluation_store,
)
from deepaccident_devkit.evaluation.runs.side_by_side import SideBySide, side_by_side
from deepaccident_devkit.evaluation.runs.text import results_text, summary_text
from deepaccident_devkit.evaluation.runs.verification import Difference, Verification, verify_bundle
from deepaccident_devkit.release.fingerprints import ScenarioHashes, scenario_hashes

__all__ = [
    "BREAKDOWNS",
    "Bundle",
    "BytesPoint",
    "ComparedNumber",
    "Comparison",
    "Coverage",
    "Difference",
    "EvaluationRun",
    "OverBytes",
    "Partial",
    "ReleaseInfo",
    "ResultsInfo",
    "SampleSelection",
    "ScenarioHashes",
    "SideBySide",
    "Verification",
    "breakdowns_of",
    "checked_target",
    "compare_bundles",
    "coverage",
    "default_selection",
    "evaluate_results",
    "evaluation_store",
    "over_bytes",
    "read_bundle",
    "read_rows",
    "results_text",
    "sample_rows",
    "save_run",
    "scenario_hashes",
    "side_by_side",
    "summary_text",
    "verify_bundle",
]
