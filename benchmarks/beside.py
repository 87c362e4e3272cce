"""Ours and what one would use in its place, by turns, on the same inputs: medians and ratios.

Each figure is a part of the devkit beside one other way to do it, which can be installed from PyPI;
those whose libraries are not here are left out. All run on one core, and what is compared is
processor time. nuscenes-devkit needs
an environment of its own: `NUSCENES_PYTHON` names the Python of one, else one is made for the run.

The released code needs more than PyPI has. `DEEPACCIDENT_RELEASED` names a folder of its
repository: then its functions run here. Else what stands beside ours is what they took once on
    another machine, and the figure's name says so.
"""

import json
import os
import subprocess
import sys
import tempfile
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
from benchmarks.measure import Figure, one_core
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.motion import MotionLabels, predict_instances
from deepaccident_devkit.motion.reference_arithmetic.outlines import TOLERANCE, pair_gaps
from deepaccident_devkit.plugins.synth import SynthConfig, make_release

Work = Callable[[], object]
ROUNDS, LEAST_SECONDS = 15, 0.02
"""Turns of each way, and how long one lasts: a way that takes less is run several times in a turn.
"""
OWN_ENVIRONMENT = ("nuscenes-devkit==1.2.0", "pandas<3", "numpy<2")
RELEASE = SynthConfig(
    scenarios=2, frames=60, image_size=(320, 180), seed=3, unplanned=0, designed=True
)
TURNS = 3
"""Of whole programs."""


def measure() -> list[Figure]:
    figures = beside_images.measure()
    with one_core():
        for work, (ours, others) in {**in_process(), **released_works()}.items():
            figures += compared(work, ours, others)
    figures += [
        figure(f"{each.name.removesuffix('_ms')}_released_elsewhere", each.value, each.reference)
        for each in (*evaluation_accident.measure(), *evaluation_detection.measure())
        if each.reference is not None
    ]
    return [*figures, *beside_nuscenes_devkit()]


def compared(work: str, ours: Work, others: Mapping[str, Work]) -> list[Figure]:
    """A figure for each other way."""
    ways = {"ours": ours, **others}
    repeats = {
        name: max(1, round(LEAST_SECONDS / max(seconds(way), 1e-6))) for name, way in ways.items()
    }
    taken: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(ROUNDS):
        for name, way in ways.items():
            taken[name].append(seconds(way, repeats[name]))
    milliseconds = {name: 1e3 * median(each) for name, each in taken.items()}
    if "released" not in others and work in ELSEWHERE:
        milliseconds["released_elsewhere"] = ELSEWHERE[work]
    mine = milliseconds.pop("ours")
    return [figure(f"{work}_{name}", mine, other) for name, other in milliseconds.items()]


def figure(name: str, ours: float, other: float, unit: str = "ms") -> Figure:
    return Figure(name=f"beside_{name}", value=ours, unit=unit, reference=other)


def seconds(way: Work, times: int = 1) -> float:
    start = time.process_time()
    for _ in range(times):
        way()
    return (time.process_time() - start) / times


def in_process() -> dict[str, tuple[Work, dict[str, Work]]]:
    """Name of a work → ours, and other ways by the name of their library."""
    source = np.random.default_rng(0)
    labels = make_labels(source)
    first, second = make_boxes(source, PAIRED), make_boxes(source, PAIRED)
    instance = predict_instances(clear_heads()).instance[0]
    ids = np.unique(instance)[1:].astype(np.int64)
    found: dict[str, tuple[Work, dict[str, Work]]] = {
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
        found["warp_bilinear"][1]["torch"] = lambda: warped_by_torch(*tensors)
    if find_spec("skimage"):
        found["gaps_of_instances"][1]["skimage"] = lambda: gaps_by_skimage(instance, ids)
    return found


def gaps_by_skimage(instance: Any, ids: Any) -> object:
    """Outlines by scikit-image and the distances of all pairs by shapely, as the released
    evaluation does it.
    """
    import shapely
    from skimage.measure import approximate_polygon, find_contours

    outlines = [
        approximate_polygon(find_contours(instance == name, 0.5)[0], tolerance=TOLERANCE)
        for name in ids
    ]
    shapes = np.array([shapely.Polygon(outline) for outline in outlines])
    first, second = np.triu_indices(len(ids), 1)
    return shapely.distance(shapes[first], shapes[second])


def as_tensors(labels: MotionLabels) -> tuple[Any, ...]:
    """Maps for nearest values (T, 6, H, W), the centres' peaks, and where each frame's points are
    (T, 2, 3).
    """
    import torch

    maps = labels.segmentation[:, None], labels.instance[:, None], labels.offset, labels.flow
    nearest = np.concatenate([np.asarray(each, dtype=np.float32) for each in maps], axis=1)
    theta = np.zeros((len(nearest), 2, 3), dtype=np.float32)
    moved = np.cumsum(labels.label_egomotion[: len(nearest), [0, 1, 5]], axis=0)
    for index, (x, y, yaw) in enumerate(np.vstack([np.zeros(3), moved])[: len(nearest)]):
        theta[index] = [[np.cos(yaw), -np.sin(yaw), x / 50], [np.sin(yaw), np.cos(yaw), y / 50]]
    return tuple(torch.from_numpy(np.array(each)) for each in (nearest, labels.centerness, theta))


def warped_by_torch(nearest: Any, centers: Any, theta: Any) -> object:
    """As FIERY and BEVerse do it: a grid of points a frame, then `grid_sample` of each map."""
    from torch.nn.functional import affine_grid, grid_sample

    grid = affine_grid(theta, list(centers.shape), align_corners=True)
    return [
        grid_sample(maps, grid, mode=mode, padding_mode="zeros", align_corners=True)
        for maps, mode in ((nearest, "nearest"), (centers, "bilinear"))
    ]


def beside_nuscenes_devkit() -> list[Figure]:
    """Both devkits open the same data, read the boxes of all samples, and evaluate the same
    detections.
    """
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        python = os.environ.get("NUSCENES_PYTHON") or own_environment(root / "environment")
        if python is None:
            return []
        dataset = DeepAccident(
            dataroot=make_release(root / "release", RELEASE, workers=2), verbose=False
        )
        export_release(dataset, root / "export", NuScenes(), workers=2)
        script = Path(__file__).with_name("beside_nuscenes.py")
        commands = {
            "other": [python, str(script), str(root)],
            "ours": [sys.executable, "-m", "benchmarks.beside_devkit", str(root)],
        }
        found: dict[str, list[dict[str, float]]] = {name: [] for name in commands}
        for _ in range(TURNS):
            for name, command in commands.items():  # the other first: it writes the detections
                said = subprocess.run(
                    command, check=True, capture_output=True, text=True, env=one_thread()
                ).stdout
                found[name].append(json.loads(said.splitlines()[-1]))
    medians = {
        name: {key: median(run[key] for run in runs) for key in runs[0]}
        for name, runs in found.items()
    }
    return [
        figure(f"{key}_nuscenes_devkit", value, medians["other"][key], unit)
        for key, value in medians["ours"].items()
        for unit in ["MB" if key.endswith("memory") else "ms"]
    ]


def one_thread() -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def own_environment(folder: Path) -> str | None:
    """The Python of a new environment with nuscenes-devkit; None if it cannot be made."""
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
