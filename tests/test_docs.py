"""The code on the pages runs as it is, and the pages list everything that they must list."""

import ast
import inspect
import re
import shlex
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from click import Context, Group
from click.testing import CliRunner
from support.repository_scripts import import_from_checkout, load_script

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.cli.export import export
from deepaccident_devkit.evaluation.accident.boxes import BoxAccidents
from deepaccident_devkit.evaluation.accident.paper import PaperAccidents
from deepaccident_devkit.evaluation.detection import DetectionProtocol
from deepaccident_devkit.evaluation.map_accidents import AccidentReading
from deepaccident_devkit.evaluation.motion import MotionProtocol
from deepaccident_devkit.evaluation.runs.setups import TASKS
from deepaccident_devkit.evaluation.warning import CleanWarnings
from deepaccident_devkit.geometry import Box, Boxes, LidarPointCloud, PinholeCamera
from deepaccident_devkit.motion import LabelProtocol, PostProcessing
from deepaccident_devkit.plugins.safety.prevention_result import PreventedResult
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.selection.fields import FIELDS, full_name
from deepaccident_devkit.validation import CODES

pytestmark = pytest.mark.slow

TOP = Path(__file__).parents[1]
DOCS = TOP / "docs"
NUSCENES_PAGE = (DOCS / "nuscenes_names.md").read_text(encoding="utf-8")
_ROWS = "\n".join(re.findall(r"^\| .* \| (.*) \|$", NUSCENES_PAGE, re.MULTILINE))
COUNTERPARTS = sorted(set(re.findall(r"`([^`\n]+)`", _ROWS)))
"""The code in the right column of the page's tables."""
PAGES = [TOP / "README.md", *sorted(DOCS.glob("*.md")), *sorted((TOP / "schema").glob("**/*.md"))]
FORMATS_WITH_OWN_PAGE = ("town-maps",)
PAGES_ABOUT_LABELS = (
    "docs/evaluators.md",
    "docs/safety.md",
    "docs/baselines.md",
)
PAGES_ABOUT_SENSORS = (
    "README.md",
    "docs/evaluating.md",
    "docs/exports.md",
    "docs/format.md",
    "docs/index.md",
    "docs/town_maps.md",
    "docs/validation.md",
)
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
EXAMPLE_VALUES = {
    "DATAROOT": "deepaccident_demo/release",
    "FILE": "deepaccident_demo/release/type1_subtype1_accident/meta/Town10HD_type001_subtype0001_scenario00001.txt",  # noqa: E501
    "LABEL": "deepaccident_demo/release/type1_subtype1_accident/ego_vehicle/label/"
    "Town10HD_type001_subtype0001_scenario00001/Town10HD_type001_subtype0001_scenario00001_001.txt",
    "OUT": "out",
    "640x360": "32x18",
}
"""Word of a command line → an example of its value that fits the demo of the tests."""
ONLY_PARSED = {
    "check splits": "tests/test_cli_audit.py runs them, and makes the files",
    "check scores": "likewise",
    "check reader": "likewise",
    "synth ": "tests/test_cli_synth.py runs them; some take minutes",
    "safety describe OUT": "it needs the output of synth",
    "render accident OUT": "tests/unit/plugins/synth/test_own_files.py runs it, on a "
    "release made from a scenario file",
    "info s3:": "tests/cloud has releases on S3",
    "study ": "tests/test_cli_study.py runs similar ones; some take hours",
    "train ": "tests/torch_extra/model/test_commands.py runs them; they need torch",
    "predict ": "likewise",
    "evaluate motion training_data": "it needs the output of predict; likewise",
    "evaluate motion DATAROOT --results results/motion ": "likewise",
    "predict constant_velocity DATAROOT --split": "tests/test_cli_predict.py runs similar ones",
    "predict constant_velocity hidden_release": "benchmarks/pages/baselines.py runs this "
    "and the next one",
    "evaluate motion hidden_release": "likewise",
    "evaluate warning DATAROOT --results all_": "it needs these predictions; "
    "tests/test_cli_evaluate.py runs similar ones",
    "check bundle benchmarks/": "tests/test_cli_evaluate.py runs a similar one",
    "results ": "tests/unit/export/nuscenes/test_detections.py runs it, and makes the file",
    "sensor-setups data/": "tests/road/test_commands.py runs it and similar ones; they "
    "need the nuScenes devkit",
    "render sample data/": "likewise",
    "evaluate motion data/": "likewise",
    "evaluate detection data/": "likewise",
    "export mcap": "tests/unit/export runs it, if the extra is installed",
    "explore ": "tests/browser/test_explore.py runs it; it runs until Ctrl-C",
}
"""Beginning of a command line that is only parsed → reason."""
NO_CALLS = (
    ".intensity",
    '"paper"',
    "link=",
    "agents=",
    '.figure.savefig("a.png")',
    '.savefig("a.png")',
    "found.pixels[found.mask]",
    "len(cloud)",
)
"""Counterparts that are no calls or names of the devkit."""


def run_page(page: Path, languages: str = "python|bash") -> dict[str, Any]:
    """Run the page's Python and shell blocks unchanged, in their order, in the working folder.

    Returns the names that the Python blocks define.
    """
    names: dict[str, Any] = {}
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(rf"^```({languages})\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
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


def link_demo(root: Path, folder: Path) -> Path:
    """Link a release at the path where `deepaccident demo` makes one; return the folder."""
    (folder / "deepaccident_demo").mkdir()
    (folder / "deepaccident_demo" / "release").symlink_to(root, target_is_directory=True)
    return folder


@pytest.fixture
def in_labels_demo(
    da_motion: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """A working folder in which `deepaccident_demo/release` is a small release with labels only."""
    monkeypatch.chdir(link_demo(da_motion.dataroot, tmp_path))
    return tmp_path


@pytest.fixture(scope="module")
def small_demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A release of an accident like the demo's, with all sensors and small images.

    It has as many frames as the pages need.
    """
    folder = tmp_path_factory.mktemp("demo")
    config = SynthConfig(scenarios=1, frames=32, image_size=(64, 36), view="hidden")
    return make_release(folder / "release", config, workers=2)


@pytest.fixture
def in_demo(small_demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder in which `deepaccident_demo/release` is the release of `small_demo`."""
    monkeypatch.chdir(link_demo(small_demo, tmp_path))
    return tmp_path


@pytest.mark.parametrize("page", PAGES_ABOUT_LABELS)
def test_the_code_on_pages_about_labels_runs(page: str, in_labels_demo: Path) -> None:
    run_page(TOP / page)


@pytest.mark.parametrize("page", PAGES_ABOUT_SENSORS)
def test_the_code_on_pages_about_sensors_runs(page: str, in_demo: Path) -> None:
    run_page(TOP / page)


def test_the_code_on_reading_runs(
    in_demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The code in the tables of nuScenes' names runs too, except for the pictures."""
    monkeypatch.setenv("DEEPACCIDENT_CACHE", str(tmp_path / "copies"))
    names = run_page(DOCS / "reading.md")
    assert names["camera"].in_image(names["pixels"]).all()

    expression = re.compile(r"(?!da\.render_)(da|box|boxes|camera|cloud|found)\.|len\(")
    codes = [code for code in COUNTERPARTS if expression.match(code)]
    assert len(codes) > 60
    for code in codes:
        eval(compile(code, "nuscenes_names.md", "eval"), names)  # noqa: S307


@pytest.mark.parametrize("protocol", [LabelProtocol, MotionProtocol])
def test_the_page_of_the_released_code_has_each_switch(protocol: type[Any]) -> None:
    page = (DOCS / "released_code.md").read_text(encoding="utf-8")
    switches = {field.name for field in fields(protocol)}
    assert {name for name in switches if not re.search(rf"[`.]{name}\b", page)} == set()
    named_switches = set(re.findall(rf"`{protocol.__name__}\.(\w+)", page))
    assert named_switches - switches == set()


CHOICE_CLASSES = (
    MotionProtocol,
    PostProcessing,
    DetectionProtocol,
    PaperAccidents,
    AccidentReading,
    BoxAccidents,
    CleanWarnings,
)
RESULT_CLASSES = (*(evaluator.result_class for evaluator in TASKS.values()), PreventedResult)


def test_the_page_of_protocols_has_each_protocol_choice_and_number() -> None:
    page = (DOCS / "protocols.md").read_text(encoding="utf-8")
    protocols = [name for evaluator in TASKS.values() for name in evaluator.protocols]
    choices = [field.name for cls in CHOICE_CLASSES for field in fields(cls)]
    paths = [row.path.removesuffix("/*") for cls in RESULT_CLASSES for row in cls.rows]
    numbers = [path.rpartition("/")[2] for path in paths]

    assert min(map(len, (protocols, choices, numbers))) > 10
    names = {*protocols, *choices, *numbers}
    assert {name for name in names if not re.search(rf"`([a-z]+\.)?{name}`", page)} == set()


@pytest.mark.parametrize("name", export.list_commands(Context(export)))
def test_every_format_has_a_row_on_the_page_of_exports(name: str) -> None:
    page = (DOCS / "exports.md").read_text(encoding="utf-8")
    first_cells = re.findall(r"^\| (.*?) \|", page, re.MULTILINE)
    has_row = any(re.search(rf"\b{name}\b", cell) for cell in first_cells)
    assert name in FORMATS_WITH_OWN_PAGE or has_row


def test_the_commands_of_the_pictures_run(da_motion: DeepAccident, in_demo: Path) -> None:
    """`docs/make_pictures.py` runs them too, but takes minutes."""
    (in_demo / "many").symlink_to(da_motion.dataroot, target_is_directory=True)
    page = DOCS / "pictures.md"
    run_page(page, "bash")
    script = load_script("docs/make_pictures.py")
    for picture in script.PICTURE.findall(page.read_text(encoding="utf-8")):
        html_name = f"{Path(picture).stem}.html"  # a picture may show a page in a browser
        paths = [*in_demo.rglob(picture), *in_demo.rglob(html_name)]
        assert picture in script.MADE_ELSEWHERE or paths, picture


def test_the_outputs_on_the_page_of_safety_are_up_to_date(in_labels_demo: Path) -> None:
    """Only the names of columns and rows are compared.

    `python docs/make_tables.py safety` measures the numbers on a larger release.
    """
    script = import_from_checkout("benchmarks.pages.safety")
    (in_labels_demo / script.RELEASE).symlink_to(in_labels_demo / "deepaccident_demo" / "release")
    page = (DOCS / "safety.md").read_text(encoding="utf-8")
    slow_commands = re.compile(r"^    deepaccident (synth|predict|evaluate) .*$", re.MULTILINE)
    new_page = script.with_outputs(slow_commands.sub("", page))

    output = re.compile(r"^<!-- output -->\n(.*?)^<!-- end", re.MULTILINE | re.DOTALL)
    old_outputs, new_outputs = output.findall(page), output.findall(new_page)
    assert len(old_outputs) == 6
    for old, new in zip(old_outputs, new_outputs, strict=True):
        # one accident is too few for these two tables
        if not re.search("^(prevented accidents|Twins)", old, re.MULTILINE):
            assert table_words(old) <= table_words(new) | {"val", "test", "…"}


def table_words(output: str) -> set[str]:
    """Return the cells without a number in the lines that have several columns."""
    words = set()
    for line in output.splitlines():
        cells = re.split(r"\s{2,}", line.strip())
        if len(cells) > 2 and not line.startswith("type"):
            words.update(cell for cell in cells if not re.search(r"\d", cell))
    return words


def test_every_field_that_finds_scenarios_is_on_the_page() -> None:
    page = (DOCS / "reading.md").read_text(encoding="utf-8")
    table = page.partition("### The fields of find")[2].partition("## ")[0]
    first_cells = re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)
    names = re.findall(r"`(\w+)`", " ".join(first_cells))

    assert sorted(names) == sorted([*FIELDS, "length", "type"])
    for name in names:
        known_values = FIELDS[full_name(name)].known
        words = [value for value in known_values if not isinstance(value, int)]
        assert [word for word in words if word.removeprefix("Town") not in table] == [], name


def test_the_known_findings_of_the_release_are_on_the_page() -> None:
    page = (DOCS / "validation.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([a-z-]+)` \|", page, re.MULTILINE)
    known_codes = [name for name, code in CODES.items() if code.known]
    assert [name for name in rows if name in CODES] == known_codes


@pytest.mark.slow
def test_the_code_on_the_page_of_studies_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The code reads the output of the page's first command."""
    monkeypatch.chdir(tmp_path)
    CliRunner().invoke(deepaccident, ["study", "v2x", "studies", "--smoke"], catch_exceptions=False)
    run_page(DOCS / "studies.md", "python")
    assert capsys.readouterr().out == "0.0\n"


def test_no_page_has_code_that_no_test_runs() -> None:
    pages_with_code = {
        page.relative_to(TOP).as_posix()
        for page in PAGES
        if "```python" in page.read_text(encoding="utf-8")
    }
    run_here = {*PAGES_ABOUT_LABELS, *PAGES_ABOUT_SENSORS, "docs/reading.md", "docs/studies.md"}
    assert pages_with_code - run_here == RUN_ELSEWHERE.keys()
    for page, test in RUN_ELSEWHERE.items():
        assert Path(page).name in (TOP / test).read_text(encoding="utf-8")


COMMANDS = [
    pytest.param(line, id=f"{page.stem}: {line[12:]}")
    for page in PAGES
    if page.name != "cli.md"  # this page is made from the commands themselves
    for line in re.findall(
        r"^    (deepaccident \S[^#\n]*[^#\s])", page.read_text(encoding="utf-8"), re.MULTILINE
    )
]
"""The command lines of the pages' indented blocks."""


@pytest.mark.parametrize("line", COMMANDS)
def test_the_command_lines_of_the_pages_run(line: str, in_demo: Path) -> None:
    _, *words = shlex.split(line.split(" > ", maxsplit=1)[0])
    words = [EXAMPLE_VALUES.get(word, word) for word in words]
    if line.removeprefix("deepaccident ").startswith(tuple(ONLY_PARSED)):
        command, context = deepaccident, Context(deepaccident)
        while isinstance(command, Group):
            name, command, words = command.resolve_command(context, words)
            context = Context(command, info_name=name, parent=context)
        command.make_parser(context).parse_args(words)  # fails if there is no such option
        return
    result = CliRunner().invoke(deepaccident, words, catch_exceptions=False)
    statuses = {0, 1} if words[0] == "validate" else {0}
    assert result.exit_code in statuses, result.output


CLASSES = {
    "da": DeepAccident,
    "DeepAccident": DeepAccident,
    "box": Box,
    "boxes": Boxes,
    "camera": PinholeCamera,
    "cloud": LidarPointCloud,
}
"""Name of an object on the page → its class."""


def find_object(expression: ast.expr) -> Any:
    """Return the object that a dotted name on the page stands for.

    For a member of `da`, `box` and the others it is the member of their class.
    """
    if isinstance(expression, ast.Subscript):
        return find_object(expression.value).__getitem__
    if isinstance(expression, ast.Attribute):
        owner = expression.value
        if isinstance(owner, ast.Name) and owner.id not in CLASSES:
            module = import_module(f"deepaccident_devkit.{owner.id}")
            return getattr(module, expression.attr)
        return getattr(find_object(owner), expression.attr)
    assert isinstance(expression, ast.Name)
    return CLASSES[expression.id]


@pytest.mark.parametrize("code", [code for code in COUNTERPARTS if code not in NO_CALLS])
def test_every_counterpart_of_a_nuscenes_call_exists(code: str) -> None:
    if code.startswith("deepaccident "):
        assert code.split()[1] in deepaccident.list_commands(Context(deepaccident))
        return
    expression = ast.parse(code, mode="eval").body
    if not isinstance(expression, ast.Call):
        find_object(expression)
        return
    arguments = list(expression.args)
    # the object of a method, or a class: `geometry.Box.from_wlh`
    owner = getattr(expression.func, "value", None)
    if owner is not None and not getattr(owner, "attr", "").istitle():
        arguments.insert(0, None)  # self
    keywords = {keyword.arg: keyword.value for keyword in expression.keywords if keyword.arg}
    inspect.signature(find_object(expression.func)).bind(*arguments, **keywords)


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "ARCHITECTURE.md", "SECURITY.md"])
def test_the_links_of_pages_outside_the_site_lead_to_a_file(page: str) -> None:
    text = (TOP / page).read_text(encoding="utf-8")
    links = re.findall(r"\]\((?!http)([^)#]+)", text)
    assert [link for link in links if not (TOP / link).exists()] == []


def test_the_picture_of_the_layers_agrees_with_the_contract() -> None:
    script = load_script("docs/make_architecture.py")
    assert script.PICTURE.read_text(encoding="utf-8") == script.picture(), (
        "run: python docs/make_architecture.py"
    )
