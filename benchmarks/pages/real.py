"""Write what a real scenario shows about velocities, jittering sensors and the index size."""

from pathlib import Path

import numpy as np

from benchmarks.measure import temporary_folder
from benchmarks.pages.marks import put
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.release import find_release
from deepaccident_devkit.tables.boxes import (
    decoded_velocities,
    displacement_velocities,
    world_centers,
)
from deepaccident_devkit.tables.build import scenario_boxes
from deepaccident_devkit.tables.scan import read_scenario, scan_scenario
from deepaccident_devkit.taxonomy import CAMERAS, CHANNELS, INFRASTRUCTURE, VELOCITY_FRAMES

MIN_SPEED = 1.0
"""Metres per second above which a box counts as moving."""
CLOSE = 0.1
"""Share of the speed below which an error counts as small."""
BYTES_A_SAMPLE, BOXES_A_SAMPLE = 310e9 / 285e3, 8.6e6 / 285e3
"""Of the whole release."""


def main(release: Path | None = None) -> None:
    """Write all texts and the table."""
    if release is None:
        raise SystemExit("real: give the folder of a release with a real scenario, --release DIR")
    with temporary_folder() as folder:
        dataset = DeepAccident("v1", release, index_dir=folder, verbose=False)
        put("velocity-real", velocity_text(release))
        put("calibration-real", calibration_text(dataset))
        put("index-real", index_table(dataset))


def velocity_text(root: Path) -> str:
    """Return how far the labels' velocities, read in each frame, are from the displacements of the
    boxes that move.
    """
    scenario = find_release(root).scenarios[0]
    files, _ = read_scenario(scenario, scan_scenario(scenario))
    boxes = scenario_boxes(files)
    label_id = boxes.labels.actor_id
    moved = displacement_velocities(world_centers(boxes), boxes.agent, label_id, boxes.frame)
    speed = np.linalg.norm(moved[:, :2], axis=1)
    is_moving = (speed > MIN_SPEED) & (label_id > 0)
    errors = {}
    for name in VELOCITY_FRAMES:
        difference = (decoded_velocities(boxes, moved, name) - moved)[is_moving, :2]
        errors[name] = np.linalg.norm(difference, axis=1) / speed[is_moving]
    released = errors.pop("released")
    median = min(np.median(error) for error in errors.values())
    share_within = max((error < CLOSE).mean() for error in errors.values())
    return (
        f"With this rule, the median error is {np.median(released):.1%} of the speed, and "
        f"{(released < CLOSE).mean():.0%} of the errors are below {CLOSE:.0%}.\n"
        f"With the other rules, the median is at least {median:.1%}, and at most "
        f"{share_within:.0%} are below {CLOSE:.0%}."
    )


def calibration_text(dataset: DeepAccident) -> str:
    """Return how far the sensors of the vehicles and of the pole jitter over the scenario."""
    matrices = dataset.columns("sample_data")["matrix"].reshape(-1, len(CHANNELS), 3, 4)
    frames = len(dataset.frame)
    changes = []
    for number in range(len(dataset.agent)):
        own = matrices[number * frames : (number + 1) * frames, : len(CAMERAS) + 1]
        shift = np.ptp(own[..., 3], axis=0).max()
        changes.append((1000 * shift, np.ptp(own[..., :3], axis=0).max()))
    names = [agent["name"] for agent in dataset.agent]
    pole_shift, pole_change = changes.pop(names.index(INFRASTRUCTURE))
    shift, change = np.max(changes, axis=0)
    rotation = matrices[:, : len(CAMERAS) + 1, :, :3]
    error = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3)).max()
    return (
        f"On vehicles, positions change by up to {shift:.2f} mm and entries of the rotation by up "
        f"to {change:.1g}, on the pole\nby up to {pole_shift:.2f} mm and {pole_change:.1g}. "
        f"Matrices are up to {error:.1g} away from a rigid transform."
    )


def index_table(dataset: DeepAccident) -> str:
    """Return the size of the index, and its size with as many boxes per sample as the whole
    release has.
    """
    index = dataset.tables_folder.parent
    samples = len(dataset.sample)
    boxes = len(dataset.annotation) / samples
    total = 0
    growing = 0  # the stored rows grow with the boxes only in part, so this is too much
    for path in index.rglob("*"):
        if path.is_file():
            size = path.stat().st_size
            total += size
            if path.stem in ("annotation", "track") or "kept" in path.parts:
                growing += size
    extra = growing * (BOXES_A_SAMPLE / boxes - 1)
    whole_release = f"with {BOXES_A_SAMPLE:.0f} boxes a sample, as the whole release has (at most)"
    sizes = {
        f"measured, {boxes:.0f} boxes a sample": total / samples,
        whole_release: (total + extra) / samples,
    }
    lines = [
        "| index of a real scenario | bytes a sample | share of the raw data |",
        "| --- | ---: | ---: |",
    ]
    for description, size in sizes.items():
        lines.append(f"| {description} | {size:,.0f} | {size / BYTES_A_SAMPLE:.2%} |")
    return "\n".join(lines)
