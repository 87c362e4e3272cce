"""The pages' code runs as it stands, and what must be listed is."""

import ast
import inspect
import math
import re
import shlex
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from click import Context, Group
from click.testing import CliRunner
from scripts import loaded_script, of_checkout

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.evaluation.accident import PROTOCOLS
from deepaccident_devkit.evaluation.accident.boxes import BoxAccidents
from deepaccident_devkit.evaluation.accident.paper import PaperAccidents
from deepaccident_devkit.evaluation.detection import DETECTION_PROTOCOLS, DetectionProtocol
from deepaccident_devkit.evaluation.map_accidents import AccidentReading
from deepaccident_devkit.evaluation.motion import MOTION_PROTOCOLS, MotionProtocol
from deepaccident_devkit.evaluation.runs.setups import TASKS
from deepaccident_devkit.evaluation.warning import WARNING_PROTOCOLS, CleanWarnings
from deepaccident_devkit.geometry import Box, Boxes, LidarPointCloud, PinholeCamera
from deepaccident_devkit.motion import LabelProtocol, MotionLabelConfig, PostProcessing
from deepaccident_devkit.plugins.safety.prevention_result import PreventedResult
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.selection.fields import FIELDS, full_name
from deepaccident_devkit.validation import CODES

pytestmark = pytest.mark.slow

TOP = Path(__file__).parents[1]
DOCS = TOP / "docs"
FROM_NUSCENES = (DOCS / "reading.md").read_text(encoding="utf-8").partition("## From the nuScenes devkit")[2]
COUNTERPARTS = sorted(
    {
        span
        for row in re.findall(r"^\| .* \| (.*) \|$", FROM_NUSCENES, re.MULTILINE)
        for span in re.findall(r"`([^`]+)`", row)
    }
)
"""The code in the right columns of that section's tables."""
WORDS_A_MINUTE = 200
PAGES = [TOP / "README.md", *sorted(DOCS.glob("*.md")), *sorted((TOP / "schema").glob("**/*.md"))]
RUN_ELSEWHERE = {
    "docs/plugins.md": "tests/test_plugin_package.py",
    "docs/clusters.md": "tests/engines/test_page.py",
    "docs/nuscenes.md": "tests/road/test_commands.py",
    "docs/pictures.md": "tests/unit/export/test_mcap.py",
    "docs/synth.md": "tests/unit/plugins/synth/test_synth_page.py",
    "docs/testing.md": "tests/unit/testing/test_page.py",
    "docs/training.md": "tests/torch_extra/test_batches.py",
    "schema/motion_labels.md": "tests/unit/motion/test_label_files.py",
    "schema/results/README.md": "tests/unit/evaluation/results/test_records.py",
}
"""Pages whose Python needs more than the demo's release, and the tests that run it."""
STAND_FOR = {
    "DATAROOT": "deepaccident_demo/release",
    "FILE": "deepaccident_demo/release/type1_subtype1_accident/meta/Town10HD_type001_subtype0001_scenario00001.txt",
    "LABEL": "deepaccident_demo/release/type1_subtype1_accident/ego_vehicle/label/"
    "Town10HD_type001_subtype0001_scenario00001/Town10HD_type001_subtype0001_scenario00001_001.txt",
    "OUT": "out",
}
"""What the words in capitals of a command line may be."""
NOT_RUN = {
    "check splits": "tests/test_cli_audit.py has them, and makes the files",
    "check scores": "likewise",
    "check reader": "likewise",
    "synth ": "tests/test_cli_synth.py has them; some take minutes",
    "safety describe OUT": "of what synth makes",
    "render accident OUT": "tests/unit/plugins/synth/test_own_files.py has it, on a release of a scenario file",
    "info s3:": "tests/cloud has releases on S3",
    "study ": "tests/test_cli_study.py has their like; some take hours",
    "train ": "tests/torch_extra/model/test_commands.py has them; they need torch",
    "predict ": "likewise",
    "evaluate motion training_data": "of what predict makes; likewise",
    "evaluate motion DATAROOT --results results/motion ": "likewise",
    "predict constant_velocity DATAROOT --split": "tests/test_cli_predict.py has their like",
    "predict constant_velocity hidden_release": "benchmarks/pages/baselines.py does that and the next one",
    "evaluate motion hidden_release": "likewise",
    "evaluate warning DATAROOT --results all_": "of what these predict; tests/test_cli_evaluate.py has their like",
    "check bundle benchmarks/": "tests/test_cli_evaluate.py has its like",
    "results ": "tests/unit/export/nuscenes/test_detections.py has it, and makes the file",
    "sensor-setups data/": "tests/road/test_commands.py has it and its like; they need the nuScenes devkit",
    "render sample data/": "likewise",
    "evaluate motion data/": "likewise",
    "evaluate detection data/": "likewise",
    "export mcap": "tests/unit/export has it, which has the extra",
    "explore ": "tests/browser/test_explore.py has it; it runs until Ctrl-C",
}
"""Command lines of pages that begin so are parsed alone, and why."""
NO_CALLS = (
    *(".intensity", '"paper"', "link=", "agents="),
    *('.figure.savefig("a.png")', '.savefig("a.png")', "found.pixels[found.mask]", "len(cloud)"),
)


def run_page(page: Path, languages: str = "python|bash") -> dict[str, Any]:
    """Run the page's Python and shell blocks, as they stand and in their order, in the working folder."""
    names: dict[str, Any] = {}
    blocks = re.findall(rf"^```({languages})\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert blocks, f"{page}: no code"
    for language, code in blocks:
        if language == "python":
            exec(compile(code, page.name, "exec"), names)  # noqa: S102
            continue
        for line in code.splitlines():
            program, *words = shlex.split(line)
            assert program == "deepaccident"
            result = CliRunner().invoke(deepaccident, words, catch_exceptions=False)
            assert result.exit_code == 0, f"{line}: {result.output}"
    return names


def folder_of_demo(root: Path, folder: Path) -> Path:
    """Lay a release where `deepaccident demo` makes one."""
    (folder / "deepaccident_demo").mkdir()
    (folder / "deepaccident_demo" / "release").symlink_to(root, target_is_directory=True)
    return folder


@pytest.fixture
def in_labels_demo(da_motion: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder in which `deepaccident_demo/release` is a small release, with labels alone."""
    monkeypatch.chdir(folder_of_demo(da_motion.dataroot, tmp_path))
    return tmp_path


@pytest.fixture(scope="module")
def small_demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An accident as the demo's, with all sensors: as many frames as the pages ask for, and small images."""
    folder = tmp_path_factory.mktemp("demo")
    config = SynthConfig(scenarios=1, frames=32, image_size=(64, 36), view="hidden")
    return make_release(folder / "release", config, workers=2)


@pytest.fixture
def in_demo(small_demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder in which `deepaccident_demo/release` is the release of `small_demo`."""
    monkeypatch.chdir(folder_of_demo(small_demo, tmp_path))
    return tmp_path


@pytest.mark.parametrize("choices", [LabelProtocol, MotionProtocol])
def test_every_switch_is_on_the_page_of_the_released_code(choices: type[Any]) -> None:
    page = (DOCS / "released_code.md").read_text(encoding="utf-8")
    assert [field.name for field in fields(choices) if not re.search(rf"[`.]{field.name}\b", page)] == []


@pytest.mark.parametrize("choices", [LabelProtocol, MotionLabelConfig, MotionProtocol])
def test_the_page_of_the_released_code_names_no_other_switch(choices: type[Any]) -> None:
    page = (DOCS / "released_code.md").read_text(encoding="utf-8")
    named = set(re.findall(rf"`{choices.__name__}\.(\w+)", page))
    assert named - {field.name for field in fields(choices)} == set()


def test_the_code_on_protocols_runs(in_labels_demo: Path) -> None:
    """The predictions there are the labels, so that they score 100."""
    names = run_page(DOCS / "protocols.md")
    result = names["halves"][0].compute()
    assert [value for each in result.ranges.values() for value in (each.iou, each.pq)] == [100] * 4
    assert names["group"].samples > 0


def test_the_code_on_evaluating_runs(in_labels_demo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_page(DOCS / "evaluating.md")
    assert "all numbers are equal" in capsys.readouterr().out


def test_the_commands_of_the_pictures_run(da_motion: DeepAccident, in_demo: Path) -> None:
    """`docs/make_pictures.py` runs them, too, and takes minutes."""
    (in_demo / "many").symlink_to(da_motion.dataroot, target_is_directory=True)
    run_page(DOCS / "pictures.md", "bash")
    script = loaded_script("docs/make_pictures.py")
    for picture in script.PICTURE.findall((DOCS / "pictures.md").read_text(encoding="utf-8")):
        page = f"{Path(picture).stem}.html"  # which a browser shows
        assert picture in script.MADE_ELSEWHERE or [*in_demo.rglob(picture), *in_demo.rglob(page)], picture


@pytest.mark.parametrize(
    "choices",
    [
        MotionProtocol,
        PostProcessing,
        DetectionProtocol,
        PaperAccidents,
        AccidentReading,
        BoxAccidents,
        CleanWarnings,
    ],
)
def test_every_choice_of_the_metrics_is_explained(choices: type[Any]) -> None:
    page = (DOCS / "protocols.md").read_text(encoding="utf-8")
    missing = [field.name for field in fields(choices) if not re.search(rf"`([a-z]+\.)?{field.name}`", page)]
    assert missing == []


@pytest.mark.parametrize("name", [*MOTION_PROTOCOLS, *DETECTION_PROTOCOLS, *PROTOCOLS, *WARNING_PROTOCOLS])
def test_every_protocol_of_the_metrics_is_explained(name: str) -> None:
    assert f"`{name}`" in (DOCS / "protocols.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("result_class", [*(each.result_class for each in TASKS.values()), PreventedResult])
def test_every_number_of_a_result_is_explained(result_class: type[Any]) -> None:
    page = (DOCS / "protocols.md").read_text(encoding="utf-8")
    numbers = [row.path.removesuffix("/*").rpartition("/")[2] for row in result_class.rows]
    assert numbers
    assert [number for number in numbers if f"`{number}`" not in page] == []


def test_the_code_on_safety_runs(in_labels_demo: Path) -> None:
    names = run_page(DOCS / "safety.md")
    assert names["story"].text.endswith("would have avoided it.")
    assert len(names["times"].gains) == 4


def test_the_outputs_on_the_page_of_safety_are_as_commands_print_them_now(in_labels_demo: Path) -> None:
    """Their headings and rows' names are compared: `python docs/make_tables.py safety` measures on a larger release."""
    script = of_checkout("benchmarks.pages.safety")
    (in_labels_demo / script.RELEASE).symlink_to(in_labels_demo / "deepaccident_demo" / "release")
    there = (DOCS / "safety.md").read_text(encoding="utf-8")
    page = re.sub(r"^    deepaccident (synth|predict|evaluate) .*$", "", there, flags=re.MULTILINE)
    now = script.with_outputs(page)
    outputs = [re.findall(r"^<!-- output -->\n(.*?)^<!-- end", text, re.MULTILINE | re.DOTALL) for text in (there, now)]
    assert len(outputs[0]) == 6
    for old, new in zip(*outputs, strict=True):
        if not re.search("^(prevented accidents|Twins)", old, re.MULTILINE):  # one accident has no such tables
            assert table_words(old) <= table_words(new) | {"val", "test", "…"}


def table_words(output: str) -> set[str]:
    """The names of columns and rows: what has no number, of lines that have several columns."""
    lines = [re.split(r"\s{2,}", line.strip()) for line in output.splitlines() if not line.startswith("type")]
    return {cell for line in lines if len(line) > 2 for cell in line if not re.search(r"\d", cell)}


def test_numbers_in_the_prose_on_safety_are_those_of_an_output() -> None:
    page = (DOCS / "safety.md").read_text(encoding="utf-8")
    outputs = "".join(re.findall(r"^```text\n(.*?)^```", page, re.MULTILINE | re.DOTALL))
    prose = re.sub(r"^```.*?^```", "", page, flags=re.MULTILINE | re.DOTALL)
    told = re.findall(r"\b\d+\.\d\d\b", prose)
    assert len(told) >= 3
    assert [number for number in told if number not in outputs] == []


def test_the_code_on_town_maps_runs(in_demo: Path) -> None:
    names = run_page(DOCS / "town_maps.md")
    assert (in_demo / "town.geojson").is_file()
    assert names["town"].drivable().any()


def test_the_code_on_baselines_runs(in_labels_demo: Path) -> None:
    """On the demo's release five agents foresee nearly all; here, too."""
    names = run_page(DOCS / "baselines.md")
    assert names["evaluator"].compute().ranges["100x100"].pq > 80
    assert names["boxes"].boxes.frame == "world"


def test_the_code_on_reading_runs(in_demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """That of its tables, too, but for the pictures."""
    monkeypatch.setenv("DEEPACCIDENT_CACHE", str(tmp_path / "copies"))
    names = run_page(DOCS / "reading.md")
    assert names["image"].shape == (36, 64, 3)
    assert tmp_path / "copies" in names["path"].parents
    assert isinstance(names["box"], Box)
    assert names["token"] is None  # the loop has come to the last sample
    da, near = names["da"], []
    for sample in da.field2token("sample", "agent_token", names["each"]["token"] + "/ego_vehicle"):
        people = [box for box in da.get_boxes(sample, frame="ego") if box.category == "pedestrian"]
        near += [sample] * any(math.hypot(*box.center[:2]) < 15 for box in people)
    assert names["near"] == near
    assert len(names["visible"]) > 0
    assert names["camera"].in_image(names["pixels"]).all()
    objects = re.compile(r"(da|box|boxes|camera|cloud|found)\.|len\(")
    codes = [code for code in COUNTERPARTS if objects.match(code) and not code.startswith("da.render_")]
    assert len(codes) > 60
    for code in codes:
        eval(compile(code, "reading.md", "eval"), names)  # noqa: S307


def test_every_field_that_finds_scenarios_is_on_the_page() -> None:
    table = (DOCS / "reading.md").read_text(encoding="utf-8").partition("### The fields of find")[2].partition("## ")[0]
    told = re.findall(r"`(\w+)`", " ".join(re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)))
    assert sorted(told) == sorted([*FIELDS, "length", "type"])
    for name in told:
        values = [str(value) for value in FIELDS[full_name(name)].known if not isinstance(value, int)]
        assert [value for value in values if value.removeprefix("Town") not in table] == [], name


def test_the_code_on_the_format_runs(in_demo: Path) -> None:
    assert run_page(DOCS / "format.md")["meta"].collision is not None


def test_what_the_release_is_known_for_is_on_the_page() -> None:
    page = (DOCS / "validation.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([a-z-]+)` \|", page, re.MULTILINE)
    assert [name for name in rows if name in CODES] == [name for name, code in CODES.items() if code.known]


@pytest.mark.parametrize("page", ["README.md", "docs/exports.md", "docs/index.md", "docs/validation.md"])
def test_the_code_on_other_pages_runs(page: str, in_demo: Path) -> None:
    run_page(TOP / page)


@pytest.mark.slow
def test_the_page_of_studies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its first command, and its code, which reads what that has written."""
    monkeypatch.chdir(tmp_path)
    CliRunner().invoke(deepaccident, ["study", "v2x", "studies", "--smoke"], catch_exceptions=False)
    run_page(DOCS / "studies.md", "python")
    assert capsys.readouterr().out == "0.0\n"


def test_no_page_has_code_that_no_test_runs() -> None:
    here = Path(__file__).read_text(encoding="utf-8")
    for page in PAGES:
        name = page.relative_to(TOP).as_posix()
        if "```python" not in page.read_text(encoding="utf-8"):
            assert name not in RUN_ELSEWHERE
        elif name in RUN_ELSEWHERE:
            assert page.name in (TOP / RUN_ELSEWHERE[name]).read_text(encoding="utf-8")
        else:
            assert f'"{page.name}"' in here or f'"{name}"' in here, name


COMMANDS = [
    pytest.param(line, id=f"{page.stem}: {line[12:]}")
    for page in PAGES
    if page.name != "cli.md"  # which is made from the commands themselves
    for line in re.findall(r"^    (deepaccident \S[^#\n]*[^#\s])", page.read_text(encoding="utf-8"), re.MULTILINE)
]
"""The command lines of the pages' indented blocks."""


@pytest.mark.parametrize("line", COMMANDS)
def test_the_command_lines_of_the_pages_run(line: str, in_demo: Path) -> None:
    _, *words = shlex.split(line.split(" > ", maxsplit=1)[0])
    words = [STAND_FOR.get(word, word) for word in words]
    if any(line[len("deepaccident ") :].startswith(begin) for begin in NOT_RUN):
        command, context = deepaccident, Context(deepaccident)
        while isinstance(command, Group):
            name, found, words = command.resolve_command(context, words)
            command, context = found, Context(found, info_name=name, parent=context)
        command.make_parser(context).parse_args(words)  # raises where there is no such option
        return
    result = CliRunner().invoke(deepaccident, words, catch_exceptions=False)
    assert result.exit_code in {0, 1} if words[0] == "validate" else result.exit_code == 0, result.output


@pytest.mark.parametrize(
    "page",
    [
        *sorted(DOCS.glob("*.md")),
        *sorted((TOP / "schema").glob("**/*.md")),
        TOP / "tutorials" / "README.md",
        TOP / "benchmarks" / "README.md",
    ],
    ids=lambda page: page.relative_to(TOP).as_posix(),
)
def test_a_page_begins_with_whom_it_is_for_and_how_long_it_takes(page: Path) -> None:
    """At 200 words a minute, a third more or less."""
    text = page.read_text(encoding="utf-8")
    told = re.match(r"# [^\n]+\n\n(?:[^\n]+\n){0,2}?[^\n]*?\b(\d+)\s+minutes?\b", text)
    assert told, f"{page.name}: no reading time below the title"
    words = len(text.split()) / WORDS_A_MINUTE
    assert abs(int(told[1]) - words) <= max(1, words / 3)


KINDS = {
    "da": DeepAccident,
    "DeepAccident": DeepAccident,
    "box": Box,
    "boxes": Boxes,
    "camera": PinholeCamera,
    "cloud": LidarPointCloud,
}
"""What the names on the page are."""


def named(expression: ast.expr) -> Any:
    """What a dotted name on the page stands for: of `da`, `box` and others the member of their class."""
    if isinstance(expression, ast.Subscript):
        return named(expression.value).__getitem__
    if isinstance(expression, ast.Attribute):
        if isinstance(expression.value, ast.Name) and expression.value.id not in KINDS:
            return getattr(import_module(f"deepaccident_devkit.{expression.value.id}"), expression.attr)
        return getattr(named(expression.value), expression.attr)
    assert isinstance(expression, ast.Name)
    return KINDS[expression.id]


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
    owner = getattr(expression.func, "value", None)  # of a method its object, or its class: `geometry.Box.from_wlh`
    of_instance = owner is not None and not getattr(owner, "attr", "").istitle()
    inspect.signature(named(expression.func)).bind(*([None] if of_instance else []), *expression.args, **keywords)


def test_the_page_says_which_pictures_are_axes_and_which_figures() -> None:
    lists = re.findall(r"^- (.*?return \w+.*?)\.$", FROM_NUSCENES.replace("\n  ", " "), re.MULTILINE)
    told = {name: line for line in lists for name in re.findall(r"`(render_\w+)`", line)}
    assert sorted(told) == sorted(name for name in dir(DeepAccident) if name.startswith("render_"))
    for name, line in told.items():
        signature = inspect.signature(getattr(DeepAccident, name))
        kind, parameter = {"Axes": ("axes", "ax"), "Figure": ("a figure", "fig"), "Path": ("the path", "path")}[
            signature.return_annotation
        ]
        assert f"return {kind}" in line, name
        assert parameter in signature.parameters, name


@pytest.mark.parametrize("page", [*sorted(TOP.glob("*.md")), *PAGES], ids=lambda page: page.name)
def test_a_page_says_for_whom_it_is(page: Path) -> None:
    assert re.match(r"# [^\n]+\n\nFor everybody ", page.read_text(encoding="utf-8"))


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "ARCHITECTURE.md", "SECURITY.md"])
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
        assert Path(inspect.getfile(inspect.unwrap(found))).as_posix().endswith(module)


def test_the_picture_of_the_layers_is_that_of_the_contract() -> None:
    script = loaded_script("docs/make_architecture.py")
    assert script.PICTURE.read_text(encoding="utf-8") == script.picture(), "run: python docs/make_architecture.py"
