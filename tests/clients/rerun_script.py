"""Run a script of an MCAP export with rerun-sdk 0.41: `python tests/clients/rerun_script.py
FOLDER`, in an environment without our devkit.

FOLDER is the output of `make_rerun_script.py`. The script runs without a window, and the plans that
rerun recorded are compared with ours in the world.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from rerun.chunk import RrdReader

AGENT = "ego_vehicle"
PATHS = f"/{AGENT}/prediction/paths/points"


def main(folder: Path) -> None:
    recording = folder / "plans.rrd"
    # With this variable, rerun saves what a script logs instead of opening its viewer.
    environment = os.environ | {"_RERUN_TEST_FORCE_SAVE": str(recording)}
    script = folder / "plans.rerun.py"
    subprocess.run([sys.executable, script], env=environment, check=True)
    poses = {}
    for row in read_rows(recording, "/tf", "Transform3D:translation"):
        if row["Transform3D:child_frame"] == [AGENT]:
            poses[row["timestamp"]] = row
    all_expected = json.loads((folder / "expected.json").read_text())
    rows = read_rows(recording, PATHS, "Points3D:positions")
    largest_error_m = 0.0
    for row, expected in zip(rows, all_expected, strict=True):
        assert row["CoordinateFrame:frame"] == [AGENT]

        points = in_world(row["Points3D:positions"], poses[row["timestamp"]])
        distances = np.linalg.norm(points - np.array(expected)[:, None], axis=-1)
        error_m = distances.min(axis=1).max()
        assert error_m < 0.01, error_m

        largest_error_m = max(largest_error_m, error_m)
    print(f"rerun: plans of {len(rows)} frames within {1000 * largest_error_m:.1g} mm: good")


def read_rows(recording: Path, entity: str, column: str) -> list[dict]:
    """Return the rows of an entity, as values by column, from all chunks that have a column."""
    rows = []
    for chunk in RrdReader(recording).stream().to_chunks():
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and column in batch.schema.names:
            rows += batch.to_pylist()
    return sorted(rows, key=lambda row: row["timestamp"])


def in_world(points: list, pose: dict) -> np.ndarray:
    """Transform points (N, 3) by a pose in the world, as rerun recorded it."""
    points = np.array(points, dtype=np.float64)
    (quaternion,) = np.array(pose["Transform3D:quaternion"])
    axis, w = quaternion[:3], quaternion[3]
    turned = np.cross(axis, points)
    rotated = points + 2 * (w * turned + np.cross(axis, turned))
    return rotated + np.array(pose["Transform3D:translation"])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
