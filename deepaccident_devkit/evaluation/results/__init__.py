"""Results files: a model's predictions for many samples, in formats that others can write.

schema/results/README.md describes the formats; `ResultsWriter` writes results and `read_results`
reads them.
"""

from deepaccident_devkit.evaluation.results.motion import MotionForm
from deepaccident_devkit.evaluation.results.reader import Prediction, Results, read_results
from deepaccident_devkit.evaluation.results.records import (
    FORMAT,
    FORMAT_VERSION,
    RESULT_SCHEMAS,
    RESULTS_NAMES,
    ResultsTask,
)
from deepaccident_devkit.evaluation.results.segmentation import SegmentationForm
from deepaccident_devkit.evaluation.results.shards import Form
from deepaccident_devkit.evaluation.results.writer import ResultsWriter

__all__ = [
    "FORMAT",
    "FORMAT_VERSION",
    "RESULTS_NAMES",
    "RESULT_SCHEMAS",
    "Form",
    "MotionForm",
    "Prediction",
    "Results",
    "ResultsTask",
    "ResultsWriter",
    "SegmentationForm",
    "read_results",
]
