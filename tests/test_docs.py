"""The pages' code runs as it stands, and what must be listed is."""

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
from scripts import loaded_script, of_checkout

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
FROM_NUSCENES = (
    (DOCS / "reading.md").read_text(encoding="utf-8").partition("## From the nuScenes devkit")[2]
)
COUNTERPARTS = sorted(
    {
        span
        for row in re.findall(r"^\| .* \| (.*) \|$", FROM_NUSCENES, re.MULTILINE)
        for span in re.findall(r"`([^`]+)`", row)
    }
)
"""The code in the right columns of that section's tables."""
PAGES = [TOP / "README.md", *sorted(DOCS.glob("*.md")), *sorted((TOP / "schema").glob("**/*.md"))]
NOT_ON_EXPORTS = ("town-maps",)
"""Formats with a page of their own."""
ON_LABELS = ("docs/protocols.md", "docs/evaluating.md", "docs/safety.md", "docs/baselines.md")
ON_SENSORS = (
    *(
        "README.md",
        "docs/exports.md",
        "docs/format.md",
        "docs/index.md",
        "docs/town_maps.md",
        "docs/validation.md",
    ),
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
STAND_FOR = {
    "DATAROOT": "deepaccident_demo/release",
    "FILE": "deepaccident_demo/release/type1_subtype1_accident/meta/Town10HD_type001_subtype0001_scenario00001.txt",  # noqa: E501
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
    "render accident OUT": "tests/unit/plugins/synth/test_own_files.py has it, on a "
    "release of a scenario file",
    "info s3:": "tests/cloud has releases on S3",
    "study ": "tests/test_cli_study.py has their like; some take hours",
    "train ": "tests/torch_extra/model/test_commands.py has them; they need torch",
    "predict ": "likewise",
    "evaluate motion training_data": "of what predict makes; likewise",
    "evaluate motion DATAROOT --results results/motion ": "likewise",
    "predict constant_velocity DATAROOT --split": "tests/test_cli_predict.py has their like",
    "predict constant_velocity hidden_release": "benchmarks/pages/baselines.py does that "
    "and the next one",
    "evaluate motion hidden_release": "likewise",
    "evaluate warning DATAROOT --results all_": "of what these predict; "
    "tests/test_cli_evaluate.py has their like",
    "check bundle benchmarks/": "tests/test_cli_evaluate.py has its like",
    "results ": "tests/unit/export/nuscenes/test_detections.py has it, and makes the file",
    "sensor-setups data/": "tests/road/test_commands.py has it and its like; they "
    "need the nuScenes devkit",
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
    """Run the page's Python and shell blocks, as they stand and in their order, in the working
    folder.
    """
    names: dict[str, Any] = {}
    blocks = re.findall(
        rf"^```({languages})\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )
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
def in_labels_demo(
    da_motion: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """A working folder in which `deepaccident_demo/release` is a small release, with labels
    alone.
    """
    monkeypatch.chdir(folder_of_demo(da_motion.dataroot, tmp_path))
    return tmp_path


@pytest.fixture(scope="module")
def small_demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An accident as the demo's, with all sensors: as many frames as the pages ask for, and small
    images.
    """
    folder = tmp_path_factory.mktemp("demo")
    config = SynthConfig(scenarios=1, frames=32, image_size=(64, 36), view="hidden")
    return make_release(folder / "release", config, workers=2)


@pytest.fixture
def in_demo(small_demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder in which `deepaccident_demo/release` is the release of `small_demo`."""
    monkeypatch.chdir(folder_of_demo(small_demo, tmp_path))
    return tmp_path


@pytest.mark.parametrize("page", ON_LABELS)
def test_the_code_on_pages_about_labels_runs(page: str, in_labels_demo: Path) -> None:
    run_page(TOP / page)


@pytest.mark.parametrize("page", ON_SENSORS)
def test_the_code_on_pages_about_sensors_runs(page: str, in_demo: Path) -> None:
    run_page(TOP / page)


def test_the_code_on_reading_runs(
    in_demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And that of its tables, except for the pictures."""
    monkeypatch.setenv("DEEPACCIDENT_CACHE", str(tmp_path / "copies"))
    names = run_page(DOCS / "reading.md")
    assert names["camera"].in_image(names["pixels"]).all()
    objects = re.compile(r"(da|box|boxes|camera|cloud|found)\.|len\(")
    codes = [
        code for code in COUNTERPARTS if objects.match(code) and not code.startswith("da.render_")
    ]
    assert len(codes) > 60
    for code in codes:
        eval(compile(code, "reading.md", "eval"), names)  # noqa: S307


@pytest.mark.parametrize("choices", [LabelProtocol, MotionProtocol])
def test_the_page_of_the_released_code_has_each_switch(choices: type[Any]) -> None:
    page = (DOCS / "released_code.md").read_text(encoding="utf-8")
    assert [
        field.name for field in fields(choices) if not re.search(rf"[`.]{field.name}\b", page)
    ] == []
    named = set(re.findall(rf"`{choices.__name__}\.(\w+)", page))
    assert named - {field.name for field in fields(choices)} == set()


CHOICES = (
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
    choices = [field.name for kind in CHOICES for field in fields(kind)]
    numbers = [
        row.path.removesuffix("/*").rpartition("/")[2]
        for kind in RESULT_CLASSES
        for row in kind.rows
    ]
    assert min(map(len, (protocols, choices, numbers))) > 10
    missing = {
        name
        for name in (*protocols, *choices, *numbers)
        if not re.search(rf"`([a-z]+\.)?{name}`", page)
    }
    assert missing == set()


@pytest.mark.parametrize("name", export.list_commands(Context(export)))
def test_every_format_has_a_row_on_the_page_of_exports(name: str) -> None:
    rows = re.findall(
        r"^\| (.*?) \|", (DOCS / "exports.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert name in NOT_ON_EXPORTS or any(re.search(rf"\b{name}\b", row) for row in rows)


def test_the_commands_of_the_pictures_run(da_motion: DeepAccident, in_demo: Path) -> None:
    """`docs/make_pictures.py` runs them, too, and takes minutes."""
    (in_demo / "many").symlink_to(da_motion.dataroot, target_is_directory=True)
    run_page(DOCS / "pictures.md", "bash")
    script = loaded_script("docs/make_pictures.py")
    for picture in script.PICTURE.findall((DOCS / "pictures.md").read_text(encoding="utf-8")):
        page = f"{Path(picture).stem}.html"  # which a browser shows
        assert picture in script.MADE_ELSEWHERE or [
            *in_demo.rglob(picture),
            *in_demo.rglob(page),
        ], picture


def test_the_outputs_on_the_page_of_safety_are_as_commands_print_them_now(
    in_labels_demo: Path,
) -> None:
    """Their headings and rows' names are compared: `python docs/make_tables.py safety` measures on
    a larger release.
    """
    script = of_checkout("benchmarks.pages.safety")
    (in_labels_demo / script.RELEASE).symlink_to(in_labels_demo / "deepaccident_demo" / "release")
    there = (DOCS / "safety.md").read_text(encoding="utf-8")
    page = re.sub(r"^    deepaccident (synth|predict|evaluate) .*$", "", there, flags=re.MULTILINE)
    now = script.with_outputs(page)
    outputs = [
        re.findall(r"^<!-- output -->\n(.*?)^<!-- end", text, re.MULTILINE | re.DOTALL)
        for text in (there, now)
    ]
    assert len(outputs[0]) == 6
    for old, new in zip(*outputs, strict=True):
        if not re.search(
            "^(prevented accidents|Twins)", old, re.MULTILINE
        ):  # one accident has no such tables
            assert table_words(old) <= table_words(new) | {"val", "test", "…"}


def table_words(output: str) -> set[str]:
    """The names of columns and rows: what has no number, of lines that have several columns."""
    lines = [
        re.split(r"\s{2,}", line.strip())
        for line in output.splitlines()
        if not line.startswith("type")
    ]
    return {cell for line in lines if len(line) > 2 for cell in line if not re.search(r"\d", cell)}


def test_every_field_that_finds_scenarios_is_on_the_page() -> None:
    table = (
        (DOCS / "reading.md")
        .read_text(encoding="utf-8")
        .partition("### The fields of find")[2]
        .partition("## ")[0]
    )
    told = re.findall(r"`(\w+)`", " ".join(re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)))
    assert sorted(told) == sorted([*FIELDS, "length", "type"])
    for name in told:
        values = [
            str(value) for value in FIELDS[full_name(name)].known if not isinstance(value, int)
        ]
        assert [value for value in values if value.removeprefix("Town") not in table] == [], name


def test_what_the_release_is_known_for_is_on_the_page() -> None:
    page = (DOCS / "validation.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([a-z-]+)` \|", page, re.MULTILINE)
    assert [name for name in rows if name in CODES] == [
        name for name, code in CODES.items() if code.known
    ]


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
    with_code = {
        page.relative_to(TOP).as_posix()
        for page in PAGES
        if "```python" in page.read_text(encoding="utf-8")
    }
    run_here = {*ON_LABELS, *ON_SENSORS, "docs/reading.md", "docs/studies.md"}
    assert with_code - run_here == RUN_ELSEWHERE.keys()
    for page, test in RUN_ELSEWHERE.items():
        assert Path(page).name in (TOP / test).read_text(encoding="utf-8")


COMMANDS = [
    pytest.param(line, id=f"{page.stem}: {line[12:]}")
    for page in PAGES
    if page.name != "cli.md"  # which is made from the commands themselves
    for line in re.findall(
        r"^    (deepaccident \S[^#\n]*[^#\s])", page.read_text(encoding="utf-8"), re.MULTILINE
    )
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
    assert result.exit_code in {0, 1} if words[0] == "validate" else result.exit_code == 0, (
        result.output
    )


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
    """What a dotted name on the page stands for: of `da`, `box` and others the member of their
    class.
    """
    if isinstance(expression, ast.Subscript):
        return named(expression.value).__getitem__
    if isinstance(expression, ast.Attribute):
        if isinstance(expression.value, ast.Name) and expression.value.id not in KINDS:
            return getattr(
                import_module(f"deepaccident_devkit.{expression.value.id}"), expression.attr
            )
        return getattr(named(expression.value), expression.attr)
    assert isinstance(expression, ast.Name)
    return KINDS[expression.id]


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
    owner = getattr(
        expression.func, "value", None
    )  # of a method its object, or its class: `geometry.Box.from_wlh`
    of_instance = owner is not None and not getattr(owner, "attr", "").istitle()
    inspect.signature(named(expression.func)).bind(
        *([None] if of_instance else []), *expression.args, **keywords
    )


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "ARCHITECTURE.md", "SECURITY.md"])
def test_the_links_of_pages_that_are_not_on_the_site_lead_somewhere(page: str) -> None:
    links = re.findall(r"\]\((?!http)([^)#]+)", (TOP / page).read_text(encoding="utf-8"))
    assert [link for link in links if not (TOP / link).exists()] == []


def test_the_picture_of_the_layers_is_that_of_the_contract() -> None:
    script = loaded_script("docs/make_architecture.py")
    assert script.PICTURE.read_text(encoding="utf-8") == script.picture(), (
        "run: python docs/make_architecture.py"
    )
