"""Measure surrogate measures of pairs, and the derived tables of interactions; optionally
SSMsOnPlane on the same pairs.

SSMsOnPlane (github.com/Yiru-Jiao/SSMsOnPlane, MIT) is no package and no dependency. To time it,
clone it, install pandas, and name the clone:

    SSMS_ON_PLANE=~/SSMsOnPlane python -m benchmarks safety

Where both give a time to collision, the two must agree, or the benchmark fails.
"""

import importlib.util
import os
import shutil
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import Figure, best_of, milliseconds, one_core, temporary_folder
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
"""Name of the environment variable with the folder of a clone."""
PAIRS, REPEATS = 20_000, 3
SIMULATED_SCENARIOS, SCENARIOS, FRAMES, AGENTS = 6, 24, 80, 5
"""Numbers of simulated scenarios, of scenarios in the release, of frames, and of agents."""
BOUND_S, BOUND_MB = 300.0, 300.0
"""Processor time on each of two cores, and size on disk, for the whole release."""


def measure() -> list[Figure]:
    boxes, velocities, speeds, rates = make_pairs(np.random.default_rng(0))
    moving_boxes = (*boxes, *velocities)
    works = {
        "gap": lambda: gaps_of_pairs(*boxes),
        "ttc": lambda: time_to_collision(*moving_boxes),
        "ttc_1d": lambda: time_to_collision_1d(*moving_boxes),
        "drac": lambda: drac(*moving_boxes),
        "mttc": lambda: modified_ttc(*boxes, *speeds, *rates),
        "closing_speed_of_boxes": lambda: closing_speed_of_boxes(*moving_boxes),
        "nearest_approach": lambda: nearest_approach(*moving_boxes),
        "pet": lambda: post_encroachment_time(*moving_boxes),
    }
    with one_core():
        figures = [pairs_per_s(name, work) for name, work in works.items()]
        figures += of_library(boxes, velocities)
    return [*figures, *of_tables()]


def pairs_per_s(name: str, work: Callable[[], object]) -> Figure:
    value = PAIRS / best_of(REPEATS, work)
    return Figure(f"safety_{name}_pairs_per_s", value, "pairs/s")


def of_tables() -> list[Figure]:
    """Measure the interactions of a synthetic release, made by two workers, and extrapolate to the
    whole release by frames.
    """
    with temporary_folder("safety") as folder:
        config = SynthConfig(
            scenarios=SIMULATED_SCENARIOS, frames=FRAMES, sensors=False, designed=True
        )
        original = make_release(folder / "made", config, workers=2)
        root = copied_release(original, folder / "release", scenarios=SCENARIOS)
        dataset = DeepAccident(dataroot=root, verbose=False)
        seconds = best_of(1, lambda: count_rows(dataset, workers=2))
        core_s = core_seconds(dataset)
        stored_s = best_of(REPEATS, lambda: count_rows(dataset, workers=1))
        rows = count_rows(dataset, workers=1)
        files = (dataset.tables_folder / FOLDER).rglob("*.arrow")
        size = sum(path.stat().st_size for path in files)
    frames = SCENARIOS * FRAMES
    factor = WHOLE_SAMPLES / AGENTS / frames
    return [
        Figure("safety_table_scenarios", SCENARIOS),
        Figure("safety_table_rows_per_frame", rows / frames),
        Figure(
            "safety_table_scenarios_per_s_2_workers",
            SCENARIOS / seconds,
            "scenarios/s",
        ),
        Figure("safety_table_kept_scenarios_per_s", SCENARIOS / stored_s, "scenarios/s"),
        milliseconds("safety_table_core_ms_per_frame", core_s / frames),
        Figure(
            "safety_table_whole_release_s_2_cores",
            core_s * factor / 2,
            "s (extrapolated)",
            bound=BOUND_S,
        ),
        Figure(
            "safety_table_whole_release_mb",
            size / 1e6 * factor,
            "MB (extrapolated)",
            bound=BOUND_MB,
        ),
    ]


def count_rows(dataset: DeepAccident, workers: int) -> int:
    """Return the number of rows of all interactions of a release, which are made if need be."""
    return sum(map(len, interactions_of(dataset, workers=workers)))


def core_seconds(dataset: DeepAccident) -> float:
    """Return the processor time to make all interactions of a release again."""
    shutil.rmtree(dataset.tables_folder / FOLDER)
    start = time.process_time()
    count_rows(dataset, workers=1)
    return time.process_time() - start


def of_library(boxes: list[np.ndarray], velocities: list[np.ndarray]) -> list[Figure]:
    """Measure SSMsOnPlane's time to collision and DRAC of the same pairs; return nothing without a
    clone of it.
    """
    checkout = os.environ.get(CHECKOUT)
    if not checkout:
        return []
    if importlib.util.find_spec("pandas") is None:
        raise SystemExit(
            f"{CHECKOUT}: SSMsOnPlane needs pandas; install it, or leave the variable out"
        )
    longitudinal = import_library(Path(checkout))
    frame = library_frame(boxes, velocities)
    theirs = np.asarray(longitudinal.TTC(frame.copy(), toreturn="values"))
    ours = time_to_collision(*boxes, *velocities)
    has_times = np.isfinite(ours) & np.isfinite(theirs) & (ours > 0) & (theirs > 0)
    if has_times.mean() < 0.1 or np.abs(ours - theirs)[has_times].max() > 1e-6:
        raise AssertionError("the two times to collision disagree")
    figures = []
    for name in ("TTC", "DRAC"):
        work = partial(getattr(longitudinal, name), frame, toreturn="values")
        figures.append(pairs_per_s(f"ssms_on_plane_{name.lower()}", work))
    return figures


def import_library(checkout: Path) -> Any:
    """Import the module `src.longitudinal_ssms` of a clone."""
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
    """Return the pairs as the table that SSMsOnPlane reads."""
    import pandas as pd

    columns: dict[str, np.ndarray] = {}
    for side, box, velocity in zip("ij", boxes, velocities, strict=True):
        x, y, length, width, yaw = box.T
        heading = np.column_stack([np.cos(yaw), np.sin(yaw)])
        values = np.column_stack([x, y, velocity, heading, length, width])
        names = ("x", "y", "vx", "vy", "hx", "hy", "length", "width")
        columns |= {f"{name}_{side}": values[:, index] for index, name in enumerate(names)}
    return pd.DataFrame(columns)


def make_pairs(source: np.random.Generator) -> tuple[list[np.ndarray], ...]:
    """Return both boxes, velocities, speeds and accelerations of pairs that mostly head for about
    the same place.
    """
    boxes, velocities, speeds, rates = [], [], [], []
    for _ in range(2):
        yaw = source.uniform(-np.pi, np.pi, PAIRS)
        speed = source.uniform(0, 15, PAIRS)
        heading = np.column_stack([np.cos(yaw), np.sin(yaw)])
        meeting_point = source.normal(0, 4, (PAIRS, 2))
        distance = speed * source.uniform(1, 5, PAIRS)
        position = meeting_point - heading * distance[:, None]
        size = source.uniform([3.5, 1.6], [9.0, 2.8], (PAIRS, 2))
        boxes.append(np.column_stack([position, size, yaw]))
        velocities.append(heading * speed[:, None])
        speeds.append(speed)
        rates.append(source.uniform(-6, 2, PAIRS))
    return boxes, velocities, speeds, rates
