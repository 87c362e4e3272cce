"""Evaluations of different sources side by side, each with its rules."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from deepaccident_devkit.evaluation.runs import side_by_side


def make_bundle(name: str, labels: str, **headlines: str) -> Any:
    summary = {
        "task": "motion",
        "protocol": "paper",
        "switches": {"labels": labels},
        "release": {"dataroot": f"data/{name}", "version": "v1"},
        "counts": {"samples": 1200},
        "headlines": [{"name": key, "text": text} for key, text in headlines.items()],
    }
    return SimpleNamespace(folder=Path("runs", name), summary=summary)


def test_a_column_has_the_rules_and_the_numbers_of_its_evaluation() -> None:
    report = side_by_side(
        [
            make_bundle("road", "fiery", iou="20.1 %", vpq="3.0 %"),
            make_bundle("ours", "clean", iou="41.0 %"),
        ]
    )

    assert report.rows == (
        ("evaluation", "road", "ours"),
        ("release", "data/road, v1", "data/ours, v1"),
        ("rules", "motion, paper, fiery", "motion, paper, clean"),
        ("samples", "1,200", "1,200"),
        ("iou", "20.1 %", "41.0 %"),
        ("vpq", "3.0 %", "–"),
    )
    assert report.to_text().endswith("no differences, since they have no sample in common")
