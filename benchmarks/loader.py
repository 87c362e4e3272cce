"""Measure items per second of `V2XDataset` with only images of 704 × 256: decoded whole, scaled and
cached, and with other loaders.

The others (`loader_rivals`) load only images, without poses. The milliseconds of an item are
processor time on one core, the fastest of several items; images are in the page cache. `normalised`
items are float32, as for ImageNet.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.loader_rivals import CROP, MEAN, SIZE, STD, Rival, rivals
from benchmarks.measure import Figure, best_of, has_torch, milliseconds, one_core, temporary_folder
from benchmarks.releases import copied_release
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.training.image_cache import CachedImages

RELEASE = SynthConfig(
    scenarios=1, frames=2, image_size=(1600, 900), seed=7, unplanned=0, designed=True
)
SCENARIOS = 4
IMAGES = ImageConfig(resize=SIZE, crop=CROP, dtype="uint8")
SCALED = replace(IMAGES, decode="scaled")
NORMALISED: dict[str, Any] = {"dtype": "float32", "mean": MEAN, "std": STD}
TEAMS: dict[str, tuple[str, ...]] = {
    "one": AGENTS[:1],
    "two": ("ego_vehicle", "infrastructure"),
    "five": AGENTS,
}
BOUNDS = {("scaled", "one"): 40.0, ("scaled", "five"): 160.0, ("cached_raw", "five"): 25.0}
"""Milliseconds of an item on one core."""
CODECS = ("raw", "jpeg")
REPEATS = 2


class PlainItems:
    """Items as one writes them without the devkit, by a rival: an agent's images, (cameras, 3, h,
    w).
    """

    def __init__(self, rival: Rival, paths: list[list[Path]], *, normalised: bool) -> None:
        self._rival = rival
        self._paths = paths
        self._normalised = normalised

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, index: int) -> Any:
        return self._rival.load(self._paths[index], normalised=self._normalised)


def measure() -> list[Figure]:
    if not has_torch("loader"):
        return []
    with temporary_folder() as root:
        original = make_release(root / "made", RELEASE, workers=2)
        release = copied_release(original, root / "release", scenarios=SCENARIOS)
        dataset = DeepAccident(dataroot=release, verbose=False)
        for codec in CODECS:
            form = CachedImages(images=SCALED, codec=codec, where=("length>=1",))  # type: ignore[arg-type]
            export_release(dataset, root / codec, form, workers=2)
        figures = [*differences(dataset), *sizes(dataset, root)]
        for team, agents in TEAMS.items():
            for name, items in make_datasets(dataset, root, agents).items():
                figures += measure_items(name, team, items)
        return figures


def make_datasets(
    dataset: DeepAccident, caches: Path | None, agents: tuple[str, ...]
) -> dict[str, Any]:
    """Return each way to make the items of the first agent's samples, by its name; caches are used
    only if there are any.
    """
    from deepaccident_devkit.training.torch import V2XConfig, V2XDataset

    tokens = [record["token"] for record in dataset.sample if record["agent"] == agents[0]]
    base = V2XConfig(agents=agents, points=False, boxes=None, images=SCALED)
    configs = {"full": replace(base, images=IMAGES), "scaled": base}
    if caches is not None:
        for codec in CODECS:
            configs[f"cached_{codec}"] = replace(base, images_cache=caches / codec)
    if len(agents) == 1:
        for name, images in (("full", IMAGES), ("scaled", SCALED)):
            normalised = replace(images, **NORMALISED)
            configs[f"{name}_normalised"] = replace(base, images=normalised)
    datasets = {name: V2XDataset(dataset, tokens, config) for name, config in configs.items()}
    if len(agents) == 1:
        paths = [
            [dataset.get_sample_data_path(token, camera) for camera in IMAGES.cameras]
            for token in tokens
        ]
        for name, rival in rivals().items():
            datasets[name] = PlainItems(rival, paths, normalised=False)
            datasets[f"{name}_normalised"] = PlainItems(rival, paths, normalised=True)
    return datasets


def measure_items(kind: str, team: str, items: Any) -> list[Figure]:
    """Return the processor time of an item, and items per second of a loader with no worker, one
    and two.
    """
    name = f"loader_{kind}_{team}"
    count = len(items)
    indices = [index % count for index in range(max(count, REPEATS))]
    with one_core():
        seconds = min(processor_seconds(items, index) for index in indices)
    bound = BOUNDS.get((kind, team))
    figures = [milliseconds(f"{name}_ms", seconds, bound)]
    for workers in (0, 1, 2):
        speed = count / loading_seconds(items, workers)
        figures.append(Figure(f"{name}_items_per_s_{workers}_workers", speed, "items/s"))
    return figures


def processor_seconds(items: Any, index: int) -> float:
    """Return the processor time of an item, which unlike elapsed time is not affected by other
    programs.
    """
    start = time.process_time()
    items[index]
    return time.process_time() - start


def loading_seconds(items: Any, workers: int) -> float:
    """Return the seconds of the fastest epoch; the workers are started before."""
    from torch.utils.data import DataLoader

    loader = DataLoader(items, num_workers=workers, persistent_workers=workers > 0)
    epoch: Callable[[], object] = lambda: [None for _ in loader]  # noqa: E731 - what is timed
    epoch()
    return best_of(REPEATS, epoch)


def differences(dataset: DeepAccident) -> list[Figure]:
    """Return how far `scaled` is from `full`, in steps of 255."""
    batches = []
    for record in dataset.sample[:10]:
        for camera in IMAGES.cameras:
            image = f"{record['token']}/{camera}"
            scaled = SCALED.load(dataset, image)[0].astype(np.int16)
            batches.append(np.abs(scaled - IMAGES.load(dataset, image)[0]).ravel())
    steps = np.concatenate(batches)
    summary = {
        "mean": float(steps.mean()),
        "99_percent": float(np.percentile(steps, 99)),
        "max": float(steps.max()),
    }
    return [
        Figure(f"loader_scaled_difference_{name}", value, "of 255")
        for name, value in summary.items()
    ]


def sizes(dataset: DeepAccident, root: Path) -> list[Figure]:
    """Return the bytes of an image: stored, and in the caches."""
    count = len(dataset.sample) * len(IMAGES.cameras)
    folders = {
        "stored": (dataset.dataroot, "*.jpg"),
        "raw": (root / "raw", "*.images"),
        "jpeg": (root / "jpeg", "*.images"),
    }
    figures = []
    for name, (folder, pattern) in folders.items():
        size = sum(path.stat().st_size for path in folder.rglob(pattern))
        kilobytes = size / count / 1e3
        figures.append(Figure(f"loader_{name}_kb_per_image", kilobytes, "kB"))
    return figures
