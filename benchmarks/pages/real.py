"""What a real scenario says of velocities, of jittering sensors, and of the size of its index."""

import tempfile
from pathlib import Path

import numpy as np

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
from deepaccident_devkit.taxonomy import CAMERAS, CATEGORIES, CHANNELS, VELOCITY_FRAMES

LEAST_SPEED = 1.0
BYTES_A_SAMPLE, BOXES_A_SAMPLE = 310e9 / 285e3, 8.6e6 / 285e3


def main(release: Path | None = None) -> None:
    """Write all tables."""
    if release is None:
        raise SystemExit("real: give the folder of a release with a real scenario, --release DIR")
    with tempfile.TemporaryDirectory() as folder:
        dataset = DeepAccident("v1", release, index_dir=folder, verbose=False)
        put("velocity-real", velocity_table(release))
        put("calibration-real", calibration_table(dataset))
        put("index-real", index_table(dataset))


def velocity_table(root: Path) -> str:
    """How far the labels' velocities, read in each frame, are from the displacements of the boxes
    that move.
    """
    scenario = find_release(root).scenarios[0]
    files, _ = read_scenario(scenario, scan_scenario(scenario))
    boxes = scenario_boxes(files)
    label_id = boxes.labels.actor_id
    moved = displacement_velocities(world_centers(boxes), boxes.agent, label_id, boxes.frame)
    speed = np.linalg.norm(moved[:, :2], axis=1)
    telling = (speed > LEAST_SPEED) & (label_id > 0)
    category = boxes.labels.category[telling]
    lines = ["| read as | boxes | median error | within 10 % | " + " | ".join(CATEGORIES) + " |"]
    lines.append("| --- " * (4 + len(CATEGORIES)) + "|")
    for name, meaning in VELOCITY_FRAMES.items():
        off = np.linalg.norm((decoded_velocities(boxes, moved, name) - moved)[telling, :2], axis=1)
        error = off / speed[telling]
        shares = [error[category == code] < 0.1 for code in range(len(CATEGORIES))]
        by_class = " | ".join(f"{np.mean(share):.0%}" if len(share) else "–" for share in shares)
        lines.append(
            f"| {meaning} | {len(error):,} | {np.median(error):.1%} | "
            f"{(error < 0.1).mean():.0%} | {by_class} |"
        )
    return "\n".join(lines)


def calibration_table(dataset: DeepAccident) -> str:
    """How far each agent's sensors jitter over the scenario."""
    lines = [
        (
            "| agent | places of a sensor | entries of its rotation | not rigid by | "
            "distinct matrices | rows |"
        ),
        "| --- " * 6 + "|",
    ]
    matrices = dataset.columns("sample_data")["matrix"].reshape(-1, len(CHANNELS), 3, 4)
    frames = len(dataset.frame)
    for number, agent in enumerate(dataset.agent):
        own = matrices[number * frames : (number + 1) * frames, : len(CAMERAS) + 1]
        turn = own[..., :3]
        rigid = np.abs(turn @ np.swapaxes(turn, -1, -2) - np.eye(3)).max()
        distinct = sum(
            len(np.unique(own[:, k].reshape(frames, -1), axis=0)) for k in range(own.shape[1])
        )
        rows = sum(row["agent_token"] == agent["token"] for row in dataset.calibrated_sensor)
        moved, turned_by = np.ptp(own[..., 3], axis=0).max(), np.ptp(turn, axis=0).max()
        lines.append(
            f"| {agent['name']} | {1000 * moved:.2f} mm | {turned_by:.1g} | "
            f"{rigid:.1g} | {distinct} | {rows} |"
        )
    return "\n".join(lines)


def index_table(dataset: DeepAccident) -> str:
    """What the index costs, and how much more it would with as many boxes a sample as the whole
    release has.
    """
    index, samples = dataset.tables_folder.parent, len(dataset.sample)
    boxes = len(dataset.annotation) / samples
    size = {path: path.stat().st_size / samples for path in index.rglob("*") if path.is_file()}
    of_boxes = sum(value for path, value in size.items() if path.stem in ("annotation", "track"))
    kept = sum(value for path, value in size.items() if "kept" in path.parts)
    whole = sum(size.values()) + (of_boxes + kept) * (
        BOXES_A_SAMPLE / boxes - 1
    )  # all that is kept, so too much
    lines = [
        "| index of a real scenario | bytes a sample | share of the raw data |",
        "| --- | ---: | ---: |",
    ]
    for words, value in (
        (f"measured, {boxes:.0f} boxes a sample", sum(size.values())),
        (f"with {BOXES_A_SAMPLE:.0f} boxes a sample, as the whole release has (at most)", whole),
    ):
        lines.append(f"| {words} | {value:,.0f} | {value / BYTES_A_SAMPLE:.2%} |")
    return "\n".join(lines)
