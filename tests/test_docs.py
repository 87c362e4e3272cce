"""The pages' code runs as it stands, and what must be listed is."""

import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.accident import PROTOCOLS
from deepaccident_devkit.evaluation.accident.boxes import BoxAccidents
from deepaccident_devkit.evaluation.accident.paper import PaperAccidents
from deepaccident_devkit.evaluation.accident.reading import AccidentReading
from deepaccident_devkit.evaluation.accident.released import ReleasedAccidents
from deepaccident_devkit.evaluation.accident.scoring import Scoring
from deepaccident_devkit.evaluation.detection import DETECTION_PROTOCOLS, DetectionProtocol
from deepaccident_devkit.evaluation.motion import MOTION_PROTOCOLS, MotionProtocol
from deepaccident_devkit.evaluation.panoptic import VpqRules
from deepaccident_devkit.evaluation.trajectory_errors import TrajectoryRules
from deepaccident_devkit.motion import LabelProtocol, PostProcessing

DOCS = Path(__file__).parents[1] / "docs"


def python_blocks(page: Path) -> str:
    blocks = re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert blocks, f"{page}: no code"
    return "\n".join(blocks)


def test_the_code_on_motion_labels_runs(
    da_motion: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = python_blocks(DOCS / "motion_labels.md")
    demo = "deepaccident_demo/release"
    assert demo in code
    monkeypatch.chdir(tmp_path)
    exec(compile(code.replace(demo, str(da_motion.dataroot)), "motion_labels.md", "exec"), {})  # noqa: S102


def test_every_switch_of_the_label_protocols_is_explained() -> None:
    page = (DOCS / "motion_labels.md").read_text(encoding="utf-8")
    missing = [field.name for field in fields(LabelProtocol) if f"`{field.name}`" not in page]
    assert missing == []


def test_the_code_on_protocols_runs(da_motion: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The session's release has but a training split; the predictions there are the labels, so that they score 100."""
    code = python_blocks(DOCS / "protocols.md").replace('"val"', '"train"')
    demo = "deepaccident_demo/release"
    assert demo in code
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(code.replace(demo, str(da_motion.dataroot)), "protocols.md", "exec"), names)  # noqa: S102
    result = names["halves"][0].compute()
    assert [value for each in result.ranges.values() for value in (each.iou, each.pq)] == [100] * 4
    assert names["group"].samples > 0
    assert (tmp_path / "motion.json").is_file()


@pytest.mark.parametrize(
    "choices",
    [
        MotionProtocol,
        VpqRules,
        TrajectoryRules,
        PostProcessing,
        DetectionProtocol,
        ReleasedAccidents,
        PaperAccidents,
        AccidentReading,
        Scoring,
        BoxAccidents,
    ],
)
def test_every_choice_of_the_metrics_is_explained(choices: type[Any]) -> None:
    page = (DOCS / "protocols.md").read_text(encoding="utf-8")
    missing = [field.name for field in fields(choices) if not re.search(rf"`([a-z]+\.)?{field.name}`", page)]
    assert missing == []


@pytest.mark.parametrize("name", [*MOTION_PROTOCOLS, *DETECTION_PROTOCOLS, *PROTOCOLS])
def test_every_protocol_of_the_metrics_is_explained(name: str) -> None:
    assert f"`{name}`" in (DOCS / "protocols.md").read_text(encoding="utf-8")
