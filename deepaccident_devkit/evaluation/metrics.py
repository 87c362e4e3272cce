"""The tasks by the paths that they had: `evaluation.metrics.accident` is `evaluation.accident`."""

import sys

from deepaccident_devkit.evaluation import accident, detection, motion, warning

for _task in (accident, detection, motion, warning):
    sys.modules[f"{__name__}.{_task.__name__.rpartition('.')[2]}"] = _task
