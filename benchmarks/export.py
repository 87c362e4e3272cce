"""Measure exports of scenarios with images and clouds in each format: samples per second and bytes
per sample, on one core.

The bound is a plain copy of the same files, in which linked files are linked: the time that the
system needs for them.
"""

import os
import shutil
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from benchmarks.measure import Figure, best_of, one_core, temporary_folder
from benchmarks.releases import copied_release
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.av2 import Av2
from deepaccident_devkit.export.bulk import Format, export_release
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.export.mmdet3d import Mmdet3d
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.export.opencood import OpenCood
from deepaccident_devkit.export.parquet import Parquet
from deepaccident_devkit.export.questions import Questions, WindowRules
from deepaccident_devkit.export.release import ReleasePart
from deepaccident_devkit.export.released_infos import ReleasedInfos
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.release import find_release
from deepaccident_devkit.training.image_cache import CachedImages

CACHE = CachedImages(
    images=ImageConfig(resize=(396, 704), crop=(140, 0, 256, 704)), where=("length>=1",)
)
QUESTIONS = Questions(window=WindowRules(observe=0.0, stride=0.5))
FORMATS: tuple[Format, ...] = (
    *(OpenCood(), NuScenes(), Mmdet3d(), ReleasedInfos(), Parquet(), Av2()),
    *(QUESTIONS, CACHE, ReleasePart()),
)
"""One format of each kind; a format that lies in another's folder comes after it."""
RELEASE = SynthConfig(scenarios=1, frames=8, image_size=(800, 450), seed=7, designed=True)
SCENARIOS = 3
REPEATS = 3


def measure() -> list[Figure]:
    with temporary_folder() as folder:
        original = make_release(folder / "made", RELEASE, workers=2)
        root = copied_release(original, folder / "release", scenarios=SCENARIOS)
        lines = [scenario.token.replace("/", " ") for scenario in find_release(root).scenarios]
        (root / "train.txt").write_text("\n".join(lines))
        dataset = DeepAccident(dataroot=root, verbose=False)
        figures = []
        for form in FORMATS:
            for variant in variants(dataset, form):
                figures += measure_export(dataset, variant)
        return figures


def variants(dataset: DeepAccident, form: Format) -> list[Format]:
    """Return the format with links, and also with copies if it has any links."""
    out = dataset.dataroot.parent / "none"
    report = export_release(dataset, out, form, dry_run=True)
    return [form, replace(form, link="copy")] if report.tally.linked else [form]


def measure_export(dataset: DeepAccident, form: Format) -> list[Figure]:
    with temporary_folder("export") as folder, one_core():
        targets = [folder / str(number) for number in range(REPEATS)]
        for target in targets:
            for other in FORMATS:
                if other.name in form.compatible_formats:
                    export_release(dataset, target, other, workers=1)
        files_before = files_in(targets[0])
        unused = iter(targets)
        seconds = best_of(REPEATS, lambda: export_release(dataset, next(unused), form, workers=1))
        files = files_in(targets[0]) - files_before
        unused_copies = iter([folder / f"plain {number}" for number in range(REPEATS)])
        plain_seconds = best_of(
            REPEATS, lambda: copy_plainly(targets[0], next(unused_copies), files)
        )
        stats = [path.stat() for path in files]
        size = sum(stat.st_size for stat in stats if stat.st_nlink == 1)
    samples = len(dataset.sample)
    name = f"export_{form.name}{'_copies' * (form.link == 'copy')}"
    return [
        Figure(
            f"{name}_samples_per_s",
            samples / seconds,
            "samples/s",
            bound=samples / plain_seconds,
            higher_is_better=True,
        ),
        Figure(f"{name}_kb_per_sample", size / samples / 1e3, "kB"),
    ]


def copy_plainly(source: Path, target: Path, files: Collection[Path]) -> None:
    """Copy files to another folder; a file with several links is linked."""
    for path in files:
        copy = target / path.relative_to(source)
        copy.parent.mkdir(parents=True, exist_ok=True)
        if path.stat().st_nlink > 1:
            os.link(path, copy)
        else:
            shutil.copyfile(path, copy)


def files_in(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if path.is_file()}
