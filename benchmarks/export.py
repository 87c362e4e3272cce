"""Exports of scenarios with images and clouds in each format: samples a second and bytes a sample,
on one core.

The bound is a plain copy of the very files, in which linked ones are linked: what the system takes
    for them.
"""

import os
import shutil
import tempfile
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from benchmarks.measure import Figure, best_of, one_core
from benchmarks.releases import copied_release
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import Format, export_release
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.export.mmdet3d import Mmdet3d
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.export.opencood import OpenCood
from deepaccident_devkit.export.parquet import Parquet
from deepaccident_devkit.export.questions import Questions, WindowRules
from deepaccident_devkit.export.released_infos import ReleasedInfos
from deepaccident_devkit.export.webdataset import WebDataset
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.release import find_release
from deepaccident_devkit.training.image_cache import CachedImages

CACHE = CachedImages(
    images=ImageConfig(resize=(396, 704), crop=(140, 0, 256, 704)), where=("length>=1",)
)
QUESTIONS = Questions(window=WindowRules(observe=0.0, stride=0.5))
FORMATS: tuple[Format, ...] = (
    *(OpenCood(), NuScenes(), Mmdet3d(), ReleasedInfos(), Parquet(), WebDataset()),
    *(QUESTIONS, CACHE),
)
"""One of each; a format that lies in another's folder comes after it."""
RELEASE = SynthConfig(scenarios=1, frames=8, image_size=(800, 450), seed=7, designed=True)
SCENARIOS = 3
REPEATS = 3


def measure() -> list[Figure]:
    with tempfile.TemporaryDirectory() as folder:
        made = make_release(Path(folder) / "made", RELEASE, workers=2)
        root = copied_release(made, Path(folder) / "release", scenarios=SCENARIOS)
        lines = [scenario.token.replace("/", " ") for scenario in find_release(root).scenarios]
        (root / "train.txt").write_text("\n".join(lines))
        dataset = DeepAccident(dataroot=root, verbose=False)
        return [
            figure
            for form in FORMATS
            for each in ways(dataset, form)
            for figure in exported(dataset, each)
        ]


def ways(dataset: DeepAccident, form: Format) -> list[Format]:
    """The format with links, and if it has any, with copies."""
    told = export_release(dataset, dataset.dataroot.parent / "none", form, dry_run=True).tally
    return [form, replace(form, link="copy")] if told.linked else [form]


def exported(dataset: DeepAccident, form: Format) -> list[Figure]:
    with tempfile.TemporaryDirectory(dir=dataset.dataroot.parent) as folder, one_core():
        places = [Path(folder) / str(number) for number in range(REPEATS)]
        for place in places:
            for other in FORMATS:
                if other.name in form.beside:
                    export_release(dataset, place, other, workers=1)
        before, left = files_in(places[0]), iter(places)
        seconds = best_of(REPEATS, lambda: export_release(dataset, next(left), form, workers=1))
        files = files_in(places[0]) - before
        left = iter([Path(folder) / f"plain {number}" for number in range(REPEATS)])
        plain_seconds = best_of(REPEATS, lambda: copy_plainly(places[0], next(left), files))
        size = sum(path.stat().st_size for path in files if path.stat().st_nlink == 1)
    samples = len(dataset.sample)
    name = f"export_{form.name}{'_copies' * (form.link == 'copy')}"
    return [
        Figure(
            name=f"{name}_samples_per_s",
            value=samples / seconds,
            unit="samples/s",
            bound=samples / plain_seconds,
            higher_is_better=True,
        ),
        Figure(name=f"{name}_kb_per_sample", value=size / samples / 1e3, unit="kB"),
    ]


def copy_plainly(source: Path, target: Path, files: Collection[Path]) -> None:
    for path in files:
        place = target / path.relative_to(source)
        place.parent.mkdir(parents=True, exist_ok=True)
        if path.stat().st_nlink > 1:
            os.link(path, place)
        else:
            shutil.copyfile(path, place)


def files_in(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if path.is_file()}
