"""Write bundles of generated counts, as `compare` reads them, without a release.

They are of the task motion, because its IoU is a plain ratio of cells.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from deepaccident_devkit.evaluation.runs.bundles import (
    COUNTS_FILE,
    SCENARIOS_FILE,
    SCENARIOS_FORMAT,
    SUMMARY_FILE,
)
from deepaccident_devkit.evaluation.runs.evaluation_run import SUMMARY_FORMAT, SUMMARY_VERSION
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup

SETUP = EvaluationSetup(task="motion")
MAIN = "iou 30x30"


def motion_counts(hit_cells: int, missed_cells: int) -> dict[str, Any]:
    """Return the counts of a sample without false alarms, the same in both ranges."""
    return {
        "samples": 1,
        "frames": 1,
        "instance_maps": 0,
        "cells": [[hit_cells, 0, missed_cells]] * 2,
        "vpq": [[[0.0], [0], [0], [0]]] * 2,
        "paths": {"ade": 0.0, "fde": 0.0, "missed": 0, "count": 0}
        | {"true_positive": 0, "false_positive": 0, "false_negative": 0},
    }


def write_bundle(
    folder: Path,
    cells: Sequence[tuple[int, int]],
    *,
    twins: bool = False,
    bytes_note: Mapping[str, Any] | None = None,
) -> Path:
    """Write a bundle with one sample in each cluster, or with two equal ones.

    Args:
        folder: Folder to write.
        cells: Hit and missed cells of each cluster.
        twins: Whether each accident has a normal twin with the same counts.
        bytes_note: Bytes that partners send, as the results note them.
    """
    kinds = ("accident", "normal") if twins else ("accident",)
    evaluator = SETUP.evaluator()
    scenarios = {}
    for number, (hit_cells, missed_cells) in enumerate(cells):
        for kind in kinds:
            scenario = f"type1_subtype1_{kind}/Town03_{number:03d}"
            evaluator.add(f"{scenario}/ego_vehicle/001", motion_counts(hit_cells, missed_cells))
            scenarios[scenario] = {"label": None, "meta": None, "calib": None}

    folder.mkdir(parents=True)
    evaluator.save(folder / COUNTS_FILE)
    summary = {
        "format": SUMMARY_FORMAT,
        "version": SUMMARY_VERSION,
        "partial": None,
        **SETUP.as_dict(),
        "split": "val",
        "samples": "evaluate",
        "scope": "all",
        "agents": None,
        "counts": {"left_out": 0},
        "release": {"version": "v1", "dataroot": "data"},
        "results": {
            "path": "results",
            "form": None,
            "meta": {} if bytes_note is None else {"bytes": bytes_note},
        },
        "breakdowns": {},
        "environment": {},
    }
    (folder / SUMMARY_FILE).write_text(json.dumps(summary))
    payload = {"format": SCENARIOS_FORMAT, "version": SUMMARY_VERSION, "scenarios": scenarios}
    (folder / SCENARIOS_FILE).write_text(json.dumps(payload))
    return folder


def change_json(path: Path, change: Callable[[Any], object]) -> None:
    """Change the content of a JSON file in place."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
