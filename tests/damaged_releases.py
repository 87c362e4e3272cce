"""A release in which scenarios lack what safety needs, each in another way."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import NamedTuple

from deepaccident_devkit import DeepAccident


class Damaged(NamedTuple):
    """The release, opened without its broken scenario, and the tokens of what is wrong."""

    dataset: DeepAccident
    without_meta: str
    without_labels: str
    broken: str
    whole: list[str]


def damaged_release(root: Path) -> Damaged:
    """Damage a release with three accidents or more and a normal scenario, in place; it keeps whole
    ones.
    """
    records = list(DeepAccident("v1", root, verbose=False).scenario)
    accidents = [each for each in records if each["collision"]]
    without_meta, without_labels = accidents[:2]
    broken = next(each for each in records if not each["collision"])
    folder = {each["token"]: root / each["folder"] / each["scenario_type"] for each in records}
    (folder[without_meta["token"]] / "meta" / f"{without_meta['name']}.txt").unlink()
    for labels in folder[without_labels["token"]].glob(f"*/label/{without_labels['name']}"):
        shutil.rmtree(labels)
    label = next(folder[broken["token"]].glob(f"*/label/{broken['name']}/*.txt"))
    label.write_text("nonsense\nnonsense\n")
    shutil.rmtree(root / ".deepaccident")
    lost = [each["token"] for each in (without_meta, without_labels, broken)]
    whole = [each["token"] for each in records if each["token"] not in lost]
    return Damaged(DeepAccident("v1", root, on_error="skip", verbose=False), *lost, whole)
