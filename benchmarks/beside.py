"""Compare the devkit with other libraries, by turns, on the same inputs: medians and ratios.

Each figure compares a part of the devkit with another way to do the same, which can be installed
from PyPI. A library that is not installed is left out. Everything runs on one core, and processor
times are compared. nuscenes-devkit needs an environment of its own: `NUSCENES_PYTHON` names the
Python of one; otherwise one is made for the run.

The released code needs more than PyPI has. If `DEEPACCIDENT_RELEASED` names a folder of its
repository, its functions run here. Otherwise ours are compared with the times that they once took
on another machine, and the names of these figures end in `_released_elsewhere`.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import Any

import click
import numpy as np

from benchmarks import beside_images, evaluation_accident, evaluation_detection
from benchmarks.beside_released import ELSEWHERE, released_works
from benchmarks.geometry import PAIRED, make_boxes, shapely_iou
from benchmarks.labels_postprocess import clear_heads
from benchmarks.labels_warp import make_labels
from benchmarks.measure import Figure, one_core, temporary_folder
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.motion import MotionLabels, predict_instances
from deepaccident_devkit.motion.reference_arithmetic.outlines import TOLERANCE, pair_gaps
from deepaccident_devkit.plugins.synth import SynthConfig, make_release

Work = Callable[[], object]
ROUNDS, LEAST_SECONDS = 15, 0.02
"""Turns of each implementation, and the shortest turn in seconds: an implementation that takes less
is run several times in a turn.
"""
OWN_ENVIRONMENT = ("nuscenes-devkit==1.2.0", "pandas<3", "numpy<2")
RELEASE = SynthConfig(
    scenarios=2, frames=60, image_size=(320, 180), seed=3, unplanned=0, designed=True
)
PROGRAM_RUNS = 3
"""Runs of each whole program."""


def measure() -> list[Figure]:
    figures = beside_images.measure()
    comparisons = {**in_process(), **released_works()}
    with one_core():
        for work, (ours, references) in comparisons.items():
            figures += compare(work, ours, references)
    for measured in (*evaluation_accident.measure(), *evaluation_detection.measure()):
        if measured.reference is not None:
            name = f"{measured.name.removesuffix('_ms')}_released_elsewhere"
            figures.append(figure(name, measured.value, measured.reference))
    return [*figures, *beside_nuscenes_devkit()]


def compare(work: str, ours: Work, references: Mapping[str, Work]) -> list[Figure]:
    """Return a figure for each other implementation of a piece of work."""
    implementations = {"ours": ours, **references}
    repeats = {}
    for name, implementation in implementations.items():
        single_s = max(processor_seconds(implementation), 1e-6)
        repeats[name] = max(1, round(LEAST_SECONDS / single_s))
    seconds = {name: [] for name in implementations}
    for _ in range(ROUNDS):
        for name, implementation in implementations.items():
            seconds[name].append(processor_seconds(implementation, repeats[name]))
    milliseconds = {name: 1e3 * median(values) for name, values in seconds.items()}
    if "released" not in references and work in ELSEWHERE:
        milliseconds["released_elsewhere"] = ELSEWHERE[work]
    our_milliseconds = milliseconds.pop("ours")
    return [
        figure(f"{work}_{name}", our_milliseconds, value) for name, value in milliseconds.items()
    ]


def figure(name: str, ours: float, other: float, unit: str = "ms") -> Figure:
    return Figure(f"beside_{name}", ours, unit, reference=other)


def processor_seconds(work: Work, repeats: int = 1) -> float:
    """Return the mean processor time of a run, in seconds."""
    start = time.process_time()
    for _ in range(repeats):
        work()
    return (time.process_time() - start) / repeats


def in_process() -> dict[str, tuple[Work, dict[str, Work]]]:
    """Return, by the name of the work, our implementation and the others by library."""
    source = np.random.default_rng(0)
    labels = make_labels(source)
    first = make_boxes(source, PAIRED)
    second = make_boxes(source, PAIRED)
    instance = predict_instances(clear_heads()).instance[0]
    ids = np.unique(instance)[1:].astype(np.int64)
    works = {
        "warp_bilinear": (lambda: labels.to_present("bilinear"), {}),
        "iou_of_rotated_boxes": (
            lambda: first.iou_bev(second),
            {"shapely": lambda: shapely_iou(first, second)},
        ),
        "gaps_of_instances": (lambda: pair_gaps(instance, ids), {}),
    }
    if find_spec("torch"):
        import torch

        torch.set_num_threads(1)
        tensors = as_tensors(labels)
        works["warp_bilinear"][1]["torch"] = lambda: warp_by_torch(*tensors)
    if find_spec("skimage"):
        works["gaps_of_instances"][1]["skimage"] = lambda: gaps_by_skimage(instance, ids)
    return works


def gaps_by_skimage(instance: Any, ids: Any) -> object:
    """Return the distances of all pairs of outlines by scikit-image and shapely, as the released
    evaluation computes them.
    """
    import shapely
    from skimage.measure import approximate_polygon, find_contours

    polygons = []
    for instance_id in ids:
        contour = find_contours(instance == instance_id, 0.5)[0]
        polygons.append(shapely.Polygon(approximate_polygon(contour, tolerance=TOLERANCE)))
    first, second = np.triu_indices(len(ids), 1)
    polygon_array = np.array(polygons)
    return shapely.distance(polygon_array[first], polygon_array[second])


def as_tensors(labels: MotionLabels) -> tuple[Any, ...]:
    """Return the maps for nearest values (T, 6, H, W), the centerness, and the affine transform of
    each frame (T, 2, 3).
    """
    import torch

    maps = labels.segmentation[:, None], labels.instance[:, None], labels.offset, labels.flow
    nearest = np.concatenate([values.astype(np.float32) for values in maps], axis=1)
    frames = len(nearest)
    theta = np.zeros((frames, 2, 3), dtype=np.float32)
    motion = labels.label_egomotion[:frames, [0, 1, 5]]  # x, y, yaw
    moved = np.vstack([np.zeros(3), np.cumsum(motion, axis=0)])
    for frame, (x, y, yaw) in enumerate(moved[:frames]):
        cos = np.cos(yaw)
        sin = np.sin(yaw)
        theta[frame] = [[cos, -sin, x / 50], [sin, cos, y / 50]]
    arrays = (nearest, labels.centerness, theta)
    return tuple(torch.from_numpy(np.array(array)) for array in arrays)


def warp_by_torch(nearest: Any, centers: Any, theta: Any) -> object:
    """Warp as FIERY and BEVerse do: make a grid of points for each frame, and sample each map."""
    from torch.nn.functional import affine_grid, grid_sample

    grid = affine_grid(theta, list(centers.shape), align_corners=True)
    return [
        grid_sample(maps, grid, mode=mode, padding_mode="zeros", align_corners=True)
        for maps, mode in ((nearest, "nearest"), (centers, "bilinear"))
    ]


def beside_nuscenes_devkit() -> list[Figure]:
    """Let both devkits open the same data, read the boxes of all samples, and evaluate the same
    detections.
    """
    with temporary_folder() as root:
        python = os.environ.get("NUSCENES_PYTHON") or own_environment(root / "environment")
        if python is None:
            return []
        release = make_release(root / "release", RELEASE, workers=2)
        dataset = DeepAccident(dataroot=release, verbose=False)
        export_release(dataset, root / "export", NuScenes(), workers=2)
        script = Path(__file__).with_name("beside_nuscenes.py")
        commands = {
            "other": [python, str(script), str(root)],
            "ours": [sys.executable, "-m", "benchmarks.beside_devkit", str(root)],
        }
        runs = {name: [] for name in commands}
        for _ in range(PROGRAM_RUNS):
            for name, command in commands.items():  # the other first: it writes the detections
                process = subprocess.run(
                    command, check=True, capture_output=True, text=True, env=one_thread()
                )
                runs[name].append(json.loads(process.stdout.splitlines()[-1]))
    figures = []
    for key in runs["ours"][0]:
        ours = median(run[key] for run in runs["ours"])
        other = median(run[key] for run in runs["other"])
        unit = "MB" if key.endswith("memory") else "ms"
        figures.append(figure(f"{key}_nuscenes_devkit", ours, other, unit))
    return figures


def one_thread() -> dict[str, str]:
    """Return the environment of a process with libraries that use one thread."""
    return {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def own_environment(folder: Path) -> str | None:
    """Make a new environment with nuscenes-devkit; return its Python, or None if that fails."""
    python = str(folder / "bin" / "python")
    install = [python, "-m", "pip", "install", "--quiet", *OWN_ENVIRONMENT]
    try:
        subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True, capture_output=True)
        subprocess.run(install, check=True, capture_output=True)
    except subprocess.CalledProcessError as error:
        click.echo(
            f"beside: nuscenes-devkit is not measured; its environment could not be made ({error})",
            err=True,
        )
        return None
    return python
