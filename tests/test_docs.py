"""The pages' code runs as it stands, and what must be listed is."""

import ast
import importlib.util
import inspect
import re
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from click import Context

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.evaluation.metrics.accident import PROTOCOLS
from deepaccident_devkit.evaluation.metrics.accident.boxes import BoxAccidents
from deepaccident_devkit.evaluation.metrics.accident.paper import PaperAccidents
from deepaccident_devkit.evaluation.metrics.accident.released import ReleasedAccidents
from deepaccident_devkit.evaluation.metrics.accident.scoring import Scoring
from deepaccident_devkit.evaluation.metrics.alarms.reading import AccidentReading
from deepaccident_devkit.evaluation.metrics.detection import DETECTION_PROTOCOLS, DetectionProtocol
from deepaccident_devkit.evaluation.metrics.motion import MOTION_PROTOCOLS, MotionProtocol
from deepaccident_devkit.evaluation.metrics.motion.overlaps import VpqRules
from deepaccident_devkit.evaluation.metrics.trajectories import TrajectoryRules
from deepaccident_devkit.evaluation.metrics.warning import (
    WARNING_PROTOCOLS,
    CleanWarnings,
    FieldQuirks,
    FieldWarnings,
    WarningProtocol,
)
from deepaccident_devkit.geometry import Box
from deepaccident_devkit.motion import LabelProtocol, MotionLabelConfig, PostProcessing

pytestmark = pytest.mark.slow

TOP = Path(__file__).parents[1]
DOCS = TOP / "docs"
FROM_NUSCENES = (DOCS / "from_nuscenes.md").read_text(encoding="utf-8")
COUNTERPARTS = sorted(
    {
        span
        for row in re.findall(r"^\| .* \| (.*) \|$", FROM_NUSCENES, re.MULTILINE)
        for span in re.findall(r"`([^`]+)`", row)
    }
)
"""The code in the right columns of that page's tables."""
NO_CALLS = ("<sample>/Camera_Front", ".intensity", '"paper"', "link=", "agents=")


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


@pytest.mark.parametrize("choices", [LabelProtocol, MotionProtocol, VpqRules, TrajectoryRules, ReleasedAccidents])
def test_every_switch_is_on_the_page_of_the_released_code(choices: type[Any]) -> None:
    page = (DOCS / "released_code.md").read_text(encoding="utf-8")
    assert [field.name for field in fields(choices) if not re.search(rf"[`.]{field.name}\b", page)] == []


@pytest.mark.parametrize("choices", [LabelProtocol, MotionLabelConfig, MotionProtocol, ReleasedAccidents, Scoring])
def test_the_page_of_the_released_code_names_no_other_switch(choices: type[Any]) -> None:
    page = (DOCS / "released_code.md").read_text(encoding="utf-8")
    named = set(re.findall(rf"`{choices.__name__}\.(\w+)", page))
    assert named - {field.name for field in fields(choices)} == set()


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


def test_the_code_on_evaluating_runs(
    da_motion: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code = python_blocks(DOCS / "evaluating.md").replace("deepaccident_demo/release", str(da_motion.dataroot))
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "evaluating.md", "exec"), {})  # noqa: S102
    assert "all numbers are equal" in capsys.readouterr().out


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
        WarningProtocol,
        CleanWarnings,
        FieldWarnings,
        FieldQuirks,
    ],
)
def test_every_choice_of_the_metrics_is_explained(choices: type[Any]) -> None:
    page = (DOCS / "protocols.md").read_text(encoding="utf-8")
    missing = [field.name for field in fields(choices) if not re.search(rf"`([a-z]+\.)?{field.name}`", page)]
    assert missing == []


@pytest.mark.parametrize("name", [*MOTION_PROTOCOLS, *DETECTION_PROTOCOLS, *PROTOCOLS, *WARNING_PROTOCOLS])
def test_every_protocol_of_the_metrics_is_explained(name: str) -> None:
    assert f"`{name}`" in (DOCS / "protocols.md").read_text(encoding="utf-8")


def test_the_code_on_baselines_runs(da_motion: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the demo's release five agents foresee nearly all; here, too."""
    code = python_blocks(DOCS / "baselines.md")
    demo = "deepaccident_demo/release"
    assert demo in code
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(code.replace(demo, str(da_motion.dataroot)), "baselines.md", "exec"), names)  # noqa: S102
    assert names["evaluator"].compute().ranges["100x100"].pq > 80
    assert names["boxes"].boxes.frame == "world"


def test_the_code_on_from_nuscenes_runs(da_motion: DeepAccident) -> None:
    code = python_blocks(DOCS / "from_nuscenes.md")
    demo = "deepaccident_demo/release"
    assert demo in code
    names: dict[str, Any] = {}
    exec(compile(code.replace(demo, str(da_motion.dataroot)), "from_nuscenes.md", "exec"), names)  # noqa: S102
    assert isinstance(names["box"], Box)


def test_the_code_on_the_format_runs(release_root: Path) -> None:
    code = python_blocks(DOCS / "format.md")
    demo = "deepaccident_demo/release"
    assert demo in code
    names: dict[str, Any] = {}
    exec(compile(code.replace(demo, str(release_root)), "format.md", "exec"), names)  # noqa: S102
    assert names["meta"].collision is not None


def test_the_code_on_the_first_page_runs(da: DeepAccident) -> None:
    code, demo = python_blocks(DOCS / "index.md"), "deepaccident_demo/release"
    assert demo in code
    code = code.replace(demo, str(da.dataroot)).replace("frame=30", "frame=3")
    exec(compile(code, "index.md", "exec"), {})  # noqa: S102


def named(expression: ast.expr) -> Any:
    """What a dotted name on the page stands for: of `da` and `box` the member of their class."""
    if isinstance(expression, ast.Attribute):
        if isinstance(expression.value, ast.Name) and expression.value.id not in ("da", "box"):
            return getattr(import_module(f"deepaccident_devkit.{expression.value.id}"), expression.attr)
        return getattr(named(expression.value), expression.attr)
    assert isinstance(expression, ast.Name)
    return {"da": DeepAccident, "DeepAccident": DeepAccident, "box": Box}[expression.id]


def test_the_counterparts_are_found_on_the_page() -> None:
    assert len(COUNTERPARTS) > 80
    assert set(NO_CALLS) <= set(COUNTERPARTS)


@pytest.mark.parametrize("code", [code for code in COUNTERPARTS if code not in NO_CALLS])
def test_every_counterpart_of_a_nuscenes_call_exists(code: str) -> None:
    if code.startswith("deepaccident "):
        assert code.split()[1] in deepaccident.list_commands(Context(deepaccident))
        return
    expression = ast.parse(code, mode="eval").body
    if not isinstance(expression, ast.Call):
        named(expression)
        return
    keywords = {keyword.arg: keyword.value for keyword in expression.keywords if keyword.arg}
    of_instance = isinstance(expression.func, ast.Attribute)
    inspect.signature(named(expression.func)).bind(*([None] if of_instance else []), *expression.args, **keywords)


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "ARCHITECTURE.md"])
def test_the_links_of_pages_that_are_not_on_the_site_lead_somewhere(page: str) -> None:
    links = re.findall(r"\]\((?!http)([^)#]+)", (TOP / page).read_text(encoding="utf-8"))
    assert [link for link in links if not (TOP / link).exists()] == []


def test_the_functions_on_a_labels_way_are_where_architecture_says() -> None:
    page = (TOP / "ARCHITECTURE.md").read_text(encoding="utf-8")
    steps = re.findall(r"\]\((deepaccident_devkit/[^)]+\.py)\), `([^`]+)`", page)
    assert len(steps) >= 5
    for module, name in steps:
        found: Any = import_module(module.removesuffix(".py").replace("/", "."))
        for part in name.split("."):
            found = getattr(found, part)
        assert Path(inspect.getfile(found)).as_posix().endswith(module)


def test_the_picture_of_the_layers_is_that_of_the_contract() -> None:
    spec = importlib.util.spec_from_file_location("make_architecture", DOCS / "make_architecture.py")
    assert spec
    assert spec.loader
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    assert script.PICTURE.read_text(encoding="utf-8") == script.picture(), "run: python docs/make_architecture.py"
