"""Items a second of `V2XDataset` with images of 704 × 256 alone, whole, scaled and cached, beside
what else loads them.

The others (`loader_rivals`) load images alone, without poses. The milliseconds of an item are
processor time on one core, the fastest of some items; images are in the page cache. `normalised`
items are float32, as for ImageNet.
"""

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.loader_rivals import CROP, MEAN, SIZE, STD, Rival, rivals
from benchmarks.measure import Figure, best_of, has_torch, one_core
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
    """What one writes without the devkit, by a rival: an agent's paths to (cameras, 3, h, w)."""

    def __init__(self, rival: Rival, paths: list[list[Path]], *, normalised: bool) -> None:
        self._rival, self._paths, self._normalised = rival, paths, normalised

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, index: int) -> Any:
        return self._rival.load(self._paths[index], normalised=self._normalised)


def measure() -> list[Figure]:
    if not has_torch("loader"):
        return []
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        made = make_release(root / "made", RELEASE, workers=2)
        dataset = DeepAccident(
            dataroot=copied_release(made, root / "release", scenarios=SCENARIOS), verbose=False
        )
        for codec in CODECS:
            form = CachedImages(images=SCALED, codec=codec, where=("length>=1",))  # type: ignore[arg-type]
            export_release(dataset, root / codec, form, workers=2)
        figures = [*differences(dataset), *sizes(dataset, root)]
        for team, agents in TEAMS.items():
            for way, items in ways(dataset, root, agents).items():
                figures += speeds(way, team, items)
        return figures


def ways(dataset: DeepAccident, caches: Path | None, agents: tuple[str, ...]) -> dict[str, Any]:
    """Each way to make the items, of the first agent's samples; out of caches only if there are
    any.
    """
    from deepaccident_devkit.training.torch import V2XConfig, V2XDataset

    tokens = [record["token"] for record in dataset.sample if record["agent"] == agents[0]]
    base = V2XConfig(agents=agents, points=False, boxes=None, images=SCALED)
    configs = {
        "full": replace(base, images=IMAGES),
        "scaled": base,
        **(
            {}
            if caches is None
            else {f"cached_{each}": replace(base, images_cache=caches / each) for each in CODECS}
        ),
    }
    found: dict[str, Any] = {
        way: V2XDataset(dataset, tokens, config) for way, config in configs.items()
    }
    if len(agents) == 1:
        paths = [
            [dataset.get_sample_data_path(token, camera) for camera in IMAGES.cameras]
            for token in tokens
        ]
        for way, images in (("full", IMAGES), ("scaled", SCALED)):
            config = replace(base, images=replace(images, **NORMALISED))
            found[f"{way}_normalised"] = V2XDataset(dataset, tokens, config)
        for name, rival in rivals().items():
            found[name] = PlainItems(rival, paths, normalised=False)
            found[f"{name}_normalised"] = PlainItems(rival, paths, normalised=True)
    return found


def speeds(way: str, team: str, items: Any) -> list[Figure]:
    """The processor time of an item, and items a second of a loader with no worker, one and two."""
    name, count = f"loader_{way}_{team}", len(items)
    with one_core():
        seconds = min(
            processor_seconds(items, index % count) for index in range(max(count, REPEATS))
        )
    figures = [
        Figure(name=f"{name}_ms", value=seconds * 1e3, unit="ms", bound=BOUNDS.get((way, team)))
    ]
    for workers in (0, 1, 2):
        value = count / loading_seconds(items, workers)
        figures.append(
            Figure(name=f"{name}_items_per_s_{workers}_workers", value=value, unit="items/s")
        )
    return figures


def processor_seconds(items: Any, index: int) -> float:
    """Of an item: where other programs work too, the clock's would be theirs as well."""
    start = time.process_time()
    items[index]
    return time.process_time() - start


def loading_seconds(items: Any, workers: int) -> float:
    """Of the fastest epoch; the workers are started before."""
    from torch.utils.data import DataLoader

    loader: Any = DataLoader(items, num_workers=workers, persistent_workers=workers > 0)
    epoch: Callable[[], object] = lambda: [None for _ in loader]  # noqa: E731 - what is timed
    epoch()
    return best_of(REPEATS, epoch)


def differences(dataset: DeepAccident) -> list[Figure]:
    """How far `scaled` and JPEG of quality 95 are from `full`, in steps of 255."""
    frames = [
        f"{record['token']}/{camera}" for record in dataset.sample[:10] for camera in IMAGES.cameras
    ]
    found = np.concatenate(
        [
            np.abs(
                SCALED.load(dataset, each)[0].astype(np.int16) - IMAGES.load(dataset, each)[0]
            ).ravel()
            for each in frames
        ]
    )
    return [
        Figure(name="loader_scaled_difference_mean", value=float(found.mean()), unit="of 255"),
        Figure(
            name="loader_scaled_difference_99_percent",
            value=float(np.percentile(found, 99)),
            unit="of 255",
        ),
        Figure(name="loader_scaled_difference_max", value=float(found.max()), unit="of 255"),
    ]


def sizes(dataset: DeepAccident, root: Path) -> list[Figure]:
    """Bytes of an image: stored, and in the caches."""
    count = len(dataset.sample) * len(IMAGES.cameras)
    folders = {
        "stored": (dataset.dataroot, "*.jpg"),
        "raw": (root / "raw", "*.images"),
        "jpeg": (root / "jpeg", "*.images"),
    }
    return [
        Figure(
            name=f"loader_{name}_kb_per_image",
            value=sum(path.stat().st_size for path in folder.rglob(pattern)) / count / 1e3,
            unit="kB",
        )
        for name, (folder, pattern) in folders.items()
    ]
