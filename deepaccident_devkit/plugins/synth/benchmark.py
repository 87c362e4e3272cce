"""Benchmarks: releases that anyone can reproduce and compare with the published ones.

See docs/benchmark.md. Labels, meta, calib and split files are the same bytes wherever they are
made, because their numbers are rounded (`SynthConfig.decimals`), which removes the last digits, in
which processors differ. Only `num_lidar_pts` (which is counted by casting rays), images and clouds
are compared within a tolerance.
"""

from __future__ import annotations

import json
import lzma
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.errors import SplitFileError
from deepaccident_devkit.plugins.synth.plan import SynthConfig
from deepaccident_devkit.release import (
    ScenarioFolder,
    find_release,
    read_bev,
    read_image,
    read_lidar,
)
from deepaccident_devkit.release.fingerprints import POINTS_TOLERANCE, digest_of, folder_hashes
from deepaccident_devkit.release.layout import frame_numbers
from deepaccident_devkit.release.store import ReleasePath, read_lines
from deepaccident_devkit.support.parallel import run_batch
from deepaccident_devkit.support.sketches import Sketch, distance, sketch, whole_numbers
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.taxonomy import AGENTS, BEV_CAMERA, CHANNEL_FORMAT, LIDAR

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

BENCHMARKS: Final[Mapping[str, SynthConfig]] = {
    "v1": SynthConfig(
        scenarios=240, image_size=(320, 180), seed=20261201, sensor_step=5, decimals=4, traffic="v1"
    )
}
"""Settings of each benchmark. However the generator evolves, it makes these byte for byte."""
TOLERANCES: Final[Mapping[str, float]] = {
    "num_lidar_pts": POINTS_TOLERANCE,
    "images": 6,
    "clouds": 25,
    "BEV pictures": 6,
}
"""Largest distance of a file from the published one: the root of the mean squared difference of its
pixels on a scale to 255; for a cloud, as described for `_sketch_file`."""
# Step between compared rows and columns; comparing all of them takes longer than decoding.
_PIXEL_STEPS = {"images": 2, "BEV pictures": 8}
# Wave vectors in space, radians for each metre, and a row of phases, radians; as good as random.
_WAVES = 2 * np.sin(np.arange(32, dtype=np.float32).reshape(4, 8) ** 2)


def described(scenario: ScenarioFolder) -> NamedValues:
    """Describe a scenario for comparison, in JSON types.

    - `meta`, `calib`: hashes of their bytes; `boxes`: of the labels without `num_lidar_pts`.
    - `num_lidar_pts`, `images`, `clouds`, `BEV pictures`: the sketch of that column, and of each
      file, by its agent, channel and frame.
    """
    hashes = folder_hashes(scenario)
    sketches: dict[str, dict[str, Sketch]] = {kind: {} for kind in TOLERANCES}
    sketches["num_lidar_pts"] = {"all agents": hashes.points}
    kind_by_channel = {LIDAR: "clouds", BEV_CAMERA: "BEV pictures"}
    for agent, (channel, ending) in product(AGENTS, CHANNEL_FORMAT.items()):
        kind = kind_by_channel.get(channel, "images")
        frames, _ = frame_numbers(scenario.kind_folder(agent, channel), ending)
        for frame in frames:
            path = scenario.channel_path(agent, channel, frame)
            sketches[kind][f"{agent}/{channel}/{frame}"] = _sketch_file(path, kind)
    return {"boxes": hashes.boxes, "meta": hashes.meta, "calib": hashes.calib, **sketches}


def described_release(root: Path, **engine: Unpack[Engine]) -> NamedValues:
    """Describe a release for comparison.

    Args:
        root: Folder of the release.
        **engine: Workers, executor and progress.

    Returns:
        `splits`, a hash of its split files, and `scenarios` by token, as from `described`.
    """
    layout = find_release(root)
    splits = {}
    for name, path in layout.split_files.items():
        splits[name] = read_lines(path, "split", SplitFileError)
    descriptions = run_batch(described, layout.scenarios, label="Comparing scenarios", **engine)
    tokens = [scenario.token for scenario in layout.scenarios]
    scenarios = dict(zip(tokens, descriptions, strict=True))
    return {"splits": digest_of(splits), "scenarios": scenarios}


def published(name: str) -> NamedValues:
    """Return the published description of a benchmark, as `described_release` returns it.

    Raises:
        ChoiceError: There is no such benchmark.
    """
    choice("benchmark", name, BENCHMARKS)
    path = Path(__file__).parent / f"benchmark_{name}.json.xz"
    text = lzma.decompress(path.read_bytes())
    return dict(json.loads(text))


def differences(release: ReadOnlyValues, benchmark: ReadOnlyValues) -> list[str]:
    """List the differences between a release and a published benchmark, one per line.

    Args:
        release: Description of the release, from `described_release`.
        benchmark: Description of the benchmark, from `published`; only the kinds of files that the
            release has are compared (`compared_kinds`).
    """
    lines = []
    if release["splits"] != benchmark["splits"]:
        lines.append("the split files differ")
    for token in sorted({*release["scenarios"], *benchmark["scenarios"]}):
        scenario = release["scenarios"].get(token)
        reference = benchmark["scenarios"].get(token)
        if scenario is None:
            lines.append(f"{token}: is missing")
            continue
        if reference is None:
            lines.append(f"{token}: is not part of the benchmark")
            continue
        for kind in ("boxes", "meta", "calib"):
            if scenario[kind] != reference[kind]:
                lines.append(f"{token}: {kind} differ")
        for kind in compared_kinds(release):
            name = _find_distant(scenario[kind], reference[kind], TOLERANCES[kind])
            if name is not None:
                lines.append(f"{token}: {kind} differ by more than the tolerance, such as {name}")
    return lines


def _find_distant(
    sketches: Mapping[str, Sketch], references: Mapping[str, Sketch], tolerance: float
) -> str | None:
    """Return the first name whose two sketches differ by more than a tolerance, or None."""
    for name in sorted({*sketches, *references}):
        pair_distance = distance(sketches.get(name, ()), references.get(name, ()))
        if pair_distance > tolerance:
            return name
    return None


def compared_kinds(release: ReadOnlyValues) -> list[str]:
    """Return the kinds of a described release that are compared within a tolerance."""
    scenarios = release["scenarios"].values()
    return [kind for kind in TOLERANCES if any(scenario[kind] for scenario in scenarios)]


def _sketch_file(path: ReleasePath, kind: str) -> Sketch:
    """Return the sketch of a sensor's file.

    For pictures, the distance of two sketches is the root of the mean squared difference of their
    pixels. The sketches of clouds are sums of waves through space over all points, in which
    brighter points count more: one point more or less changes each sum by up to 1.5.
    """
    if kind == "clouds":
        cloud = read_lidar(path)
        phases = cloud.xyz.astype(np.float32) @ _WAVES[:3] + _WAVES[3]
        sums = (0.5 + cloud.intensity) @ np.cos(phases)
        return whole_numbers(sums)
    image = read_image(path) if kind == "images" else read_bev(path, raw=True)
    step = _PIXEL_STEPS[kind]
    pixels = image[::step, ::step]
    centered_pixels = pixels - np.float32(128)
    return sketch(centered_pixels / np.sqrt(pixels.size))
