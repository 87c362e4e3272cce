"""Benchmarks: releases that anybody makes anew, and whether a release is as published (docs/benchmark.md).

Labels, meta, calib and split files are the same bytes wherever they are made: their numbers are rounded
(`SynthConfig.decimals`), and what processors compute differently in the last digits is gone. But what is counted by
rays, `num_lidar_pts`, and images and clouds are compared within a tolerance.
"""

from __future__ import annotations

import json
import lzma
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

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
from deepaccident_devkit.taxonomy import AGENTS, BEV_CAMERA, CHANNEL_FORMAT, LIDAR

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

# Benchmark → what it is made of. Whatever the generator learns, these stay as they are, byte for byte.
BENCHMARKS: Final[Mapping[str, SynthConfig]] = {
    "v1": SynthConfig(
        scenarios=240, image_size=(320, 180), seed=20261201, sensor_step=5, decimals=4, traffic="v1"
    )
}
# How far a file may be from the published one: the root of the mean squared difference of its pixels on a scale to
# 255; of a cloud, as `_sketch_of` says. docs/benchmark.md says what was measured.
TOLERANCES: Final[Mapping[str, float]] = {
    "num_lidar_pts": POINTS_TOLERANCE,
    "images": 6,
    "clouds": 25,
    "BEV pictures": 6,
}
# Rows and columns from each that is compared to the next one: to compare all would take longer than to decode them.
_STEPS: Final = {"images": 2, "BEV pictures": 8}
# Wave vectors of space, radians a metre, and a row of phases, radians; as good as random.
_WAVES: Final = 2 * np.sin(np.arange(32, dtype=np.float32).reshape(4, 8) ** 2)


def described(scenario: ScenarioFolder) -> dict[str, Any]:
    """Return what is compared of a scenario, as JSON holds it.

    - `meta`, `calib`: hashes of their bytes; `boxes`: of those of the labels, without `num_lidar_pts`.
    - `num_lidar_pts`, `images`, `clouds`, `BEV pictures`: the sketch of that column, and of each file, by its agent,
      channel and frame.
    """
    hashes = folder_hashes(scenario)
    sketches: dict[str, dict[str, Sketch]] = {kind: {} for kind in TOLERANCES}
    sketches["num_lidar_pts"] = {"all agents": hashes.points}
    for agent, (channel, ending) in product(AGENTS, CHANNEL_FORMAT.items()):
        kind = {LIDAR: "clouds", BEV_CAMERA: "BEV pictures"}.get(channel, "images")
        for frame in frame_numbers(scenario.kind_folder(agent, channel), ending)[0]:
            path = scenario.channel_path(agent, channel, frame)
            sketches[kind][f"{agent}/{channel}/{frame}"] = _sketch_of(path, kind)
    return {"boxes": hashes.boxes, "meta": hashes.meta, "calib": hashes.calib, **sketches}


def described_release(root: Path, **how: Unpack[Engine]) -> dict[str, Any]:
    """What is compared of a release: `splits`, a hash of its split files, and `scenarios` by token, as `described`."""
    layout = find_release(root)
    splits = {
        name: read_lines(path, "split", SplitFileError) for name, path in layout.split_files.items()
    }
    made = run_batch(described, layout.scenarios, label="comparing", **how)
    tokens = [scenario.token for scenario in layout.scenarios]
    return {"splits": digest_of(splits), "scenarios": dict(zip(tokens, made, strict=True))}


def published(name: str) -> dict[str, Any]:
    """What `described_release` says of a benchmark as it was published; raises ChoiceError for an unknown one."""
    choice("benchmark", name, BENCHMARKS)
    path = Path(__file__).parent / f"benchmark_{name}.json.xz"
    return dict(json.loads(lzma.decompress(path.read_bytes())))


def differences(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """Return where a release is not as published, a line each.

    Args:
        found: of `described_release`.
        wanted: of `published`; only the kinds of files that the release has are compared (`compared_kinds`).
    """
    lines = ["its split files differ"] if found["splits"] != wanted["splits"] else []
    for token in sorted({*found["scenarios"], *wanted["scenarios"]}):
        here, there = found["scenarios"].get(token), wanted["scenarios"].get(token)
        if here is None or there is None:
            lines.append(f"{token}: is {'missing' if here is None else 'not of the benchmark'}")
            continue
        lines += [
            f"{token}: {kind} differ"
            for kind in ("boxes", "meta", "calib")
            if here[kind] != there[kind]
        ]
        for kind in compared_kinds(found):
            mine, theirs = here[kind], there[kind]
            names = sorted({*mine, *theirs})
            far = [
                name
                for name in names
                if distance(mine.get(name, ()), theirs.get(name, ())) > TOLERANCES[kind]
            ]
            lines += [
                f"{token}: {kind} differ by more than the tolerance, such as {name}"
                for name in far[:1]
            ]
    return lines


def compared_kinds(found: Mapping[str, Any]) -> list[str]:
    """Return what a release, described by `described_release`, has of all that is compared within a tolerance."""
    return [
        kind
        for kind in TOLERANCES
        if any(scenario[kind] for scenario in found["scenarios"].values())
    ]


def _sketch_of(path: ReleasePath, kind: str) -> Sketch:
    """Return the sketch of a sensor's file.

    Of pictures, the distance of two sketches is the root of the mean squared difference of their pixels. Those of
    clouds are sums of waves through space over all points, of which brighter ones count more: one point more or less
    changes each sum by up to 1.5.
    """
    if kind == "clouds":
        cloud = read_lidar(path)
        return whole_numbers(
            (0.5 + cloud.intensity) @ np.cos(cloud.xyz.astype(np.float32) @ _WAVES[:3] + _WAVES[3])
        )
    step = _STEPS[kind]
    pixels = (read_image(path) if kind == "images" else read_bev(path, raw=True))[::step, ::step]
    return sketch((pixels - np.float32(128)) / np.sqrt(pixels.size))
