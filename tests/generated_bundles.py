"""Bundles of generated counts, as `compare` reads them, without a release: motion, whose IoU is a
ratio of cells.
"""

import json
from collections.abc import Mapping, Sequence
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


def motion_counts(found: int, missed: int) -> dict[str, Any]:
    """Of a sample of so many true cells, in both ranges; no alarm is false."""
    return {
        "samples": 1,
        "frames": 1,
        "instance_maps": 0,
        "cells": [[found, 0, missed]] * 2,
        "vpq": [[[0.0], [0], [0], [0]]] * 2,
        "paths": {"ade": 0.0, "fde": 0.0, "missed": 0, "count": 0}
        | {"true_positive": 0, "false_positive": 0, "false_negative": 0},
    }


def write_bundle(
    folder: Path,
    cells: Sequence[tuple[int, int]],
    *,
    twins: bool = False,
    sent: Mapping[str, Any] | None = None,
) -> Path:
    """A bundle of a sample a cluster, or of two that are equal: of an accident and of its twin.

    Args:
        folder: to write.
        cells: found and missed, of each cluster.
        twins: whether each accident has its twin.
        sent: what the results note of the bytes that partners send.
    """
    counts: dict[str, Mapping[str, Any]] = {
        f"type1_subtype1_{kind}/Town03_{number:03d}/ego_vehicle/001": motion_counts(*each)
        for number, each in enumerate(cells)
        for kind in (("accident", "normal") if twins else ("accident",))
    }
    evaluator = SETUP.evaluator()
    for token, each in counts.items():
        evaluator.add(token, each)
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
            "meta": {} if sent is None else {"bytes": sent},
        },
        "breakdowns": {},
        "environment": {},
    }
    (folder / SUMMARY_FILE).write_text(json.dumps(summary))
    scenarios = {
        token.rsplit("/", 2)[0]: {"label": None, "meta": None, "calib": None} for token in counts
    }
    stated = {"format": SCENARIOS_FORMAT, "version": SUMMARY_VERSION, "scenarios": scenarios}
    (folder / SCENARIOS_FILE).write_text(json.dumps(stated))
    return folder
