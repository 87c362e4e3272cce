"""Export questions of a small release and read the files back."""

import json
from pathlib import Path
from typing import Any, NamedTuple

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import Exported, export_release
from deepaccident_devkit.export.questions import Questions


class QuestionFiles(NamedTuple):
    """The files of an export of questions.

    Attributes:
        done: Report of the export.
        lines: Bytes of the question by sample.
        truth: Line of the truth file by sample.
    """

    done: Exported
    lines: dict[str, bytes]
    truth: dict[str, dict[str, Any]]

    def question(self, sample: str) -> dict[str, Any]:
        question: dict[str, Any] = json.loads(self.lines[sample])
        return question


def read_questions(done: Exported) -> QuestionFiles:
    truth_lines = (done.folder / "truth.jsonl").read_bytes().splitlines()
    truths = [json.loads(line) for line in truth_lines]
    questions = (done.folder / "questions" / "questions.jsonl").read_bytes().splitlines()
    line_by_id = {json.loads(line)["id"]: line for line in questions}
    assert [truth["id"] for truth in truths] == list(line_by_id) == sorted(line_by_id)
    return QuestionFiles(
        done,
        lines={truth["sample"]: line_by_id[truth["id"]] for truth in truths},
        truth={truth["sample"]: truth for truth in truths},
    )


def export_and_read(dataset: DeepAccident, folder: Path, form: Questions) -> QuestionFiles:
    """Export questions into a new subfolder of `folder` and read them back."""
    number = len(list(folder.glob("questions *")))
    done = export_release(
        dataset,
        folder / f"questions {number}",
        form,
        workers=1,
    )
    return read_questions(done)


def accident_scenario(dataset: DeepAccident) -> str:
    """Return the token of the first scenario with a collision."""
    return next(record["token"] for record in dataset.scenario if record["collision"])
