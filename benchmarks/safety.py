"""Surrogate measures of pairs, and the derived tables of interactions; SSMsOnPlane on the same
pairs beside them.

SSMsOnPlane (github.com/Yiru-Jiao/SSMsOnPlane, MIT) is no package and no dependency. To time it,
clone it, install pandas, and name the clone:

    SSMS_ON_PLANE=~/SSMsOnPlane python -m benchmarks safety

Where both know a time to collision, the two must agree, or the benchmark fails.
"""

import importlib.util
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import Figure, best_of, one_core
from benchmarks.releases import WHOLE_SAMPLES, copied_release
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.interactions import (
    closing_speed_of_boxes,
    drac,
    gaps_of_pairs,
    interactions_of,
    modified_ttc,
    nearest_approach,
    post_encroachment_time,
    time_to_collision,
    time_to_collision_1d,
)
from deepaccident_devkit.interactions.scenario import FOLDER
from deepaccident_devkit.plugins.synth import SynthConfig, make_release

CHECKOUT = "SSMS_ON_PLANE"
"""Environment variable with the folder of a clone."""
PAIRS, REPEATS = 20_000, 3
MADE, SCENARIOS, FRAMES, AGENTS = 6, 24, 80, 5
"""Scenarios that are simulated, and that the release has, under other names; frames of each."""
BOUND_S, BOUND_MB = 300.0, 300.0
"""The whole release on two cores, of whose processor time the seconds are, and on disk."""


def measure() -> list[Figure]:
    boxes, velocities, speeds, rates = make_pairs(np.random.default_rng(0))
    there = (*boxes, *velocities)
    work: dict[str, Callable[[], object]] = {
        "gap": lambda: gaps_of_pairs(*boxes),
        "ttc": lambda: time_to_collision(*there),
        "ttc_1d": lambda: time_to_collision_1d(*there),
        "drac": lambda: drac(*there),
        "mttc": lambda: modified_ttc(*boxes, *speeds, *rates),
        "closing_speed_of_boxes": lambda: closing_speed_of_boxes(*there),
        "nearest_approach": lambda: nearest_approach(*there),
        "pet": lambda: post_encroachment_time(*there),
    }
    with one_core():
        figures = [
            Figure(
                name=f"safety_{name}_pairs_per_s",
                value=PAIRS / best_of(REPEATS, each),
                unit="pairs/s",
            )
            for name, each in work.items()
        ]
        figures += of_library(boxes, velocities)
    return [*figures, *of_tables()]


def of_tables() -> list[Figure]:
    """The interactions of a release of synthetic scenarios, made by two workers, and the whole
    release's by frames.
    """
    with tempfile.TemporaryDirectory(prefix="deepaccident_safety_") as name:
        folder = Path(name)
        config = SynthConfig(scenarios=MADE, frames=FRAMES, sensors=False, designed=True)
        root = copied_release(
            make_release(folder / "made", config, workers=2),
            folder / "release",
            scenarios=SCENARIOS,
        )
        dataset = DeepAccident(dataroot=root, verbose=False)
        seconds = best_of(1, lambda: [len(each) for each in interactions_of(dataset, workers=2)])
        core = core_seconds(dataset)
        again = best_of(
            REPEATS, lambda: [len(each) for each in interactions_of(dataset, workers=1)]
        )
        found = list(interactions_of(dataset, workers=1))
        size = sum(
            path.stat().st_size for path in (dataset.tables_folder / FOLDER).rglob("*.arrow")
        )
    share = WHOLE_SAMPLES / AGENTS / (SCENARIOS * FRAMES)
    return [
        Figure(name="safety_table_scenarios", value=SCENARIOS),
        Figure(
            name="safety_table_rows_per_frame", value=sum(map(len, found)) / (SCENARIOS * FRAMES)
        ),
        Figure(
            name="safety_table_scenarios_per_s_2_workers",
            value=SCENARIOS / seconds,
            unit="scenarios/s",
        ),
        Figure(
            name="safety_table_kept_scenarios_per_s", value=SCENARIOS / again, unit="scenarios/s"
        ),
        Figure(
            name="safety_table_core_ms_per_frame",
            value=core * 1e3 / (SCENARIOS * FRAMES),
            unit="ms",
        ),
        Figure(
            name="safety_table_whole_release_s_2_cores",
            value=core * share / 2,
            unit="s (extrapolated)",
            bound=BOUND_S,
        ),
        Figure(
            name="safety_table_whole_release_mb",
            value=size / 1e6 * share,
            unit="MB (extrapolated)",
            bound=BOUND_MB,
        ),
    ]


def core_seconds(dataset: DeepAccident) -> float:
    """Processor time of making all interactions of a release again, whatever else the machine
    does.
    """
    shutil.rmtree(dataset.tables_folder / FOLDER)
    start = time.process_time()
    for _ in interactions_of(dataset, workers=1):
        pass
    return time.process_time() - start


def of_library(boxes: list[np.ndarray], velocities: list[np.ndarray]) -> list[Figure]:
    """SSMsOnPlane's time to collision and DRAC of the same pairs; nothing without a clone of it."""
    checkout = os.environ.get(CHECKOUT)
    if not checkout:
        return []
    if importlib.util.find_spec("pandas") is None:
        raise SystemExit(
            f"{CHECKOUT}: SSMsOnPlane needs pandas; install it, or leave the variable out"
        )
    longitudinal, frame = library_of(Path(checkout)), library_frame(boxes, velocities)
    theirs = np.asarray(longitudinal.TTC(frame.copy(), toreturn="values"))
    ours = time_to_collision(*boxes, *velocities)
    both = np.isfinite(ours) & np.isfinite(theirs) & (ours > 0) & (theirs > 0)
    if both.mean() < 0.1 or np.abs(ours - theirs)[both].max() > 1e-6:
        raise AssertionError("the two times to collision disagree")
    return [
        Figure(
            name=f"safety_ssms_on_plane_{name.lower()}_pairs_per_s",
            value=PAIRS
            / best_of(
                REPEATS, lambda name=name: getattr(longitudinal, name)(frame, toreturn="values")
            ),
            unit="pairs/s",
        )
        for name in ("TTC", "DRAC")
    ]


def library_of(checkout: Path) -> Any:
    """The module `src.longitudinal_ssms` of a clone."""
    if not (checkout / "src" / "longitudinal_ssms.py").is_file():
        raise SystemExit(
            f"{CHECKOUT}: {checkout} has no src/longitudinal_ssms.py; name a clone of SSMsOnPlane"
        )
    sys.path.insert(0, str(checkout))
    try:
        return importlib.import_module("src.longitudinal_ssms")
    finally:
        sys.path.remove(str(checkout))


def library_frame(boxes: list[np.ndarray], velocities: list[np.ndarray]) -> Any:
    """The pairs as the table that SSMsOnPlane reads."""
    import pandas as pd

    columns: dict[str, np.ndarray] = {}
    for side, box, velocity in zip("ij", boxes, velocities, strict=True):
        heading = np.column_stack([np.cos(box[:, 4]), np.sin(box[:, 4])])
        values = np.column_stack([box[:, :2], velocity, heading, box[:, 2:4]])
        names = ("x", "y", "vx", "vy", "hx", "hy", "length", "width")
        columns |= {f"{name}_{side}": values[:, position] for position, name in enumerate(names)}
    return pd.DataFrame(columns)


def make_pairs(source: np.random.Generator) -> tuple[list[np.ndarray], ...]:
    """Both boxes, velocities, speeds and accelerations of pairs, most of which head for about the
    same place.
    """
    boxes, velocities, speeds, rates = [], [], [], []
    for _ in range(2):
        yaw, speed = source.uniform(-np.pi, np.pi, PAIRS), source.uniform(0, 15, PAIRS)
        heading = np.column_stack([np.cos(yaw), np.sin(yaw)])
        place = (
            source.normal(0, 4, (PAIRS, 2))
            - heading * (speed * source.uniform(1, 5, PAIRS))[:, None]
        )
        size = source.uniform([3.5, 1.6], [9.0, 2.8], (PAIRS, 2))
        boxes.append(np.column_stack([place, size, yaw]))
        velocities.append(heading * speed[:, None])
        speeds.append(speed)
        rates.append(source.uniform(-6, 2, PAIRS))
    return boxes, velocities, speeds, rates
