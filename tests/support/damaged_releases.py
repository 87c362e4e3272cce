"""A release in which each damaged scenario lacks something else that safety needs."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import NamedTuple

from deepaccident_devkit import DeepAccident


class DamagedRelease(NamedTuple):
    """The release, opened without its broken scenario, and the tokens of the damaged scenarios."""

    dataset: DeepAccident
    without_meta: str
    without_labels: str
    broken: str
    whole: list[str]


def damage_release(root: Path) -> DamagedRelease:
    """Damage a release that has at least three accidents and a normal scenario, in place; some
    scenarios stay whole.
    """
    records = list(DeepAccident("v1", root, verbose=False).scenario)
    without_meta, without_labels = [record for record in records if record["collision"]][:2]
    broken = next(record for record in records if not record["collision"])
    folders = {
        record["token"]: root / record["folder"] / record["scenario_type"] for record in records
    }

    (folders[without_meta["token"]] / "meta" / f"{without_meta['name']}.txt").unlink()
    for label_folder in folders[without_labels["token"]].glob(f"*/label/{without_labels['name']}"):
        shutil.rmtree(label_folder)
    label = next(folders[broken["token"]].glob(f"*/label/{broken['name']}/*.txt"))
    label.write_text("nonsense\nnonsense\n")
    shutil.rmtree(root / ".deepaccident")

    damaged = [record["token"] for record in (without_meta, without_labels, broken)]
    whole = [record["token"] for record in records if record["token"] not in damaged]
    dataset = DeepAccident("v1", root, on_error="skip", verbose=False)
    return DamagedRelease(dataset, *damaged, whole)
