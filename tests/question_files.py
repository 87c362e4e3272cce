"""Questions of a small release, read back from the files."""

import json
from pathlib import Path
from typing import Any, NamedTuple

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import Exported, export_release
from deepaccident_devkit.export.questions import Questions


class Asked(NamedTuple):
    """An export of questions.

    Attributes:
        done: what the export says.
        lines: sample → the bytes of its question.
        truth: sample → its line of the truth.
    """

    done: Exported
    lines: dict[str, bytes]
    truth: dict[str, dict[str, Any]]

    def question(self, sample: str) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.lines[sample])
        return found


def read_back(done: Exported) -> Asked:
    truth = [json.loads(line) for line in (done.folder / "truth.jsonl").read_bytes().splitlines()]
    lines = (done.folder / "questions" / "questions.jsonl").read_bytes().splitlines()
    by_id = {json.loads(line)["id"]: line for line in lines}
    assert [each["id"] for each in truth] == list(by_id) == sorted(by_id)
    return Asked(
        done,
        {each["sample"]: by_id[each["id"]] for each in truth},
        {each["sample"]: each for each in truth},
    )


def ask(dataset: DeepAccident, folder: Path, form: Questions) -> Asked:
    """Export questions of a release into a new folder below, and read them back."""
    out = folder / f"questions {len(list(folder.glob('questions *')))}"
    return read_back(export_release(dataset, out, form, workers=1))


def accident_of(dataset: DeepAccident) -> str:
    """The token of the scenario with a collision."""
    return next(each["token"] for each in dataset.scenario if each["collision"])
