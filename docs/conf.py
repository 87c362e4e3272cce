"""Build the documentation site: the guides as they lie in the repository, and an API reference from
the docstrings.

    pip install '.[docs]' && sphinx-build -W --keep-going -c docs . build/site

The repository's root is the source folder, so that links between docs/, schema/ and tutorials/ are
the same on GitHub and on the site. Nothing is fetched from a network.
"""

import re
from importlib import import_module
from pathlib import Path
from typing import Any

from deepaccident_devkit import __version__
from deepaccident_devkit.errors import MissingExtraError

project = "DeepAccident devkit"
author = "The DeepAccident devkit developers"
project_copyright = "the DeepAccident devkit developers, Apache-2.0"
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "docs/index"
include_patterns = [
    "docs/*.md",
    "docs/api/*.md",
    "schema/**.md",
    "tutorials/*.md",
    "benchmarks/*.md",
    "ARCHITECTURE.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "RELEASING.md",
    "SECURITY.md",
]
templates_path = ["templates"]
html_theme = "furo"
html_title = project
html_static_path = ["static"]
html_css_files = ["code.css"]
html_additional_pages = {"index": "to_docs.html"}  # for readers who open the folder
html_copy_source = False

myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_mock_imports = [
    "torch",
    "safetensors",
]  # the adapter and the model are described without them
napoleon_numpy_docstring = False
napoleon_attr_annotations = False  # signatures have the types
napoleon_use_ivar = True  # attributes are a list below their class, not an entry each

REFERENCE = {
    "The release": ("DeepAccident", "taxonomy", "support.reports", "errors"),
    "Boxes, poses, clouds, grids": ("geometry",),
    "V2X": ("v2x",),
    "Collisions and interactions": ("collisions", "interactions", "descriptions", "maps"),
    "Safety": (
        "plugins.safety",
        "plugins.safety.prevention",
        "plugins.safety.prevention_result",
        "plugins.safety.figures",
        "plugins.safety.page",
    ),
    "Motion labels": ("motion",),
    "Evaluation": (
        "evaluation",
        "evaluation.drawing",
        "evaluation.motion",
        "evaluation.accident",
        "evaluation.detection",
        "evaluation.tracking",
        "evaluation.warning",
        "evaluation.planning",
        "evaluation.forecasting",
        "evaluation.segmentation",
    ),
    "Results files and whole evaluations": (
        "evaluation.results",
        "evaluation.runs.setups",
        "evaluation.runs",
        "evaluation.runs.sanity",
    ),
    "Baselines": ("plugins.baselines",),
    "Pictures": ("render.figures.Layer", "render", "render.evaluation"),
    "Splits, samples and queries": ("selection", "selection.samples", "selection.splits"),
    "Validation and statistics": ("validation", "statistics", "plugins.audit"),
    "Files of a release": ("release",),
    "Synthetic releases": ("plugins.synth", "plugins.synth.spec"),
    "The test kit": ("testing", "testing.plugin", "testing.strategies"),
    "Other frameworks": (
        "training.torch",
        "training.image_cache",
        "export.mcap",
        "export.bulk",
        "export.opencood.OpenCood",
        "export.nuscenes.NuScenes",
        "export.mmdet3d.Mmdet3d",
        "export.released_infos.ReleasedInfos",
        "export.release.ReleasePart",
        "export.parquet.Parquet",
        "export.av2.Av2",
        "export.clips.Clips",
        "export.nuscenes.detections",
    ),
    "The model": ("plugins.model",),
    "nuScenes": (
        "plugins.nuscenes",
        "plugins.nuscenes.items.NuScenesDataset",
        "plugins.nuscenes.check",
        "plugins.nuscenes.sensor_setups",
        "plugins.nuscenes.results",
    ),
    "Plug-ins": ("plugins", "evaluation.evaluator", "evaluation.means", "evaluation.task.Row"),
    "Studies": ("plugins.study",),
    "The explorer": ("plugins.explore",),
}
"""Title of a page → modules, classes and types that it lists."""
INTERNAL = ("MAX_MESSAGE_LENGTH", "MAX_QUOTE_LENGTH", "MAX_REASON_LENGTH", "escaped", "shortened")
"""Names that no page lists, of modules without `__all__`."""
INTRODUCTION = """# API reference

For everybody who programs with the devkit: all public names, with what they take, return and raise. A page to look
things up in.

`DeepAccident` is where to begin: functions of a release that are used much are its methods, too
(`da.motion_labels(sample)` is `motion.motion_labels(da, sample)`). Arrays are numpy's: `FloatArray` has float64,
`IntArray` int64, `BoolArray` bool, `ByteArray` uint8; docstrings say the shapes. What every function takes (`dataset`,
`sample`, `workers`) is explained [on one page](../conventions.md#what-functions-take). Whatever the devkit raises on
purpose is a `DeepAccidentError`. Modules that are not listed here may change without notice.
"""


def write_reference(folder: Path) -> None:
    """Write the pages of the reference; they are not stored in the repository."""
    folder.mkdir(exist_ok=True)
    listed_names = set()
    pages = []
    for title, modules in REFERENCE.items():
        page = re.sub(r"\W+", "_", title.lower())
        pages.append(page)
        text = f"# {title}\n\n"
        for module in modules:
            directive = _directive(module, listed_names)
            text += f"## `{module}`\n\n```{{eval-rst}}\n{directive}\n```\n\n"
        (folder / f"{page}.md").write_text(text.removesuffix("\n"), encoding="utf-8")
    tree = "\n".join(["```{toctree}", ":maxdepth: 2", "", *pages, "```", ""])
    (folder / "index.md").write_text(f"{INTRODUCTION}\n{tree}", encoding="utf-8")


def _directive(name: str, listed_names: set[str]) -> str:
    """Return the autodoc directive of a module, without names on an earlier page, or of a class or
    a type.
    """
    path = f"deepaccident_devkit.{name}"
    if name == "DeepAccident":
        return f".. autoclass:: {path}\n   :members:\n   :inherited-members:"
    if name.rpartition(".")[2][0].isupper():
        return f".. {'autodata' if name.endswith('Layer') else 'autoclass'}:: {path}"
    directive = f".. automodule:: {path}"
    try:
        public = getattr(import_module(path), "__all__", None)
    except MissingExtraError:  # autodoc mocks what it lacks
        return f"{directive}\n   :members:\n   :imported-members:"
    if public is None:
        return f"{directive}\n   :members:\n   :exclude-members: {', '.join(INTERNAL)}"
    members = [member for member in public if member not in listed_names]
    listed_names.update(public)
    if members:  # an empty list would mean all
        directive += f"\n   :members: {', '.join(members)}"
    return f"{directive}\n   :imported-members:"


_CODE_SPAN = re.compile(r"(?<![`\\])`([^`]+)`(?!`)")
_ARRAY = re.compile(
    r"~?(numpy\.)?ndarray\[tuple\[[^\]]*\], "
    r"~?(numpy\.)?dtype\[~?(numpy\.|typing\.)*(?P<dtype>\w+)\]\]"
)
_ARRAY_NAMES = {
    "float64": "FloatArray",
    "int64": "IntArray",
    "bool": "BoolArray",
    "uint8": "ByteArray",
}
"""Names in `deepaccident_devkit.support.arrays`."""
_WITHOUT_TYPE = ("attribute", "data", "property")
"""Objects in which napoleon reads a first line with a colon as `type: text`."""
_SECTIONS = ("Args:", "Attributes:", "Examples:", "Raises:", "Returns:", "Yields:")


def restructured(lines: list[str]) -> list[str]:
    """Return a docstring's lines as reStructuredText; doctests, and the sections that napoleon
    parses, stay.
    """
    result: list[str] = []
    block: list[str] = []
    kind = "text"
    for number, line in enumerate(lines):
        line_kind = _kind(line, kind, lines[:number])
        if line_kind != kind:
            result += _CONVERTERS[kind](block) if block else []
            kind, block = line_kind, []
        block.append(line)
    return result + _CONVERTERS[kind](block)


def _kind(line: str, kind: str, before: list[str]) -> str:
    """Return what a line belongs to: `fence`, `table`, `doctest`, `example` (indented code) or
    `text`.
    """
    words = line.strip()
    is_in_fence = kind == "fence" and before[-1].strip() != "```"
    if is_in_fence or words.startswith("```"):
        return "fence"
    if words.startswith("|") and words.endswith("|"):
        return "table"
    if words.startswith(">>>") or (kind == "doctest" and words):
        return "doctest"
    is_indented = line.startswith("    ")
    if kind == "example":
        return "example" if is_indented or not words else "text"
    starts_block = not before or not before[-1].strip()
    if is_indented and starts_block and not _in_section(before):
        return "example"
    return "text"


def _in_section(before: list[str]) -> bool:
    """Return whether the last line that is not indented begins a section."""
    for line in reversed(before):
        if line and not line.startswith(" "):
            return line in _SECTIONS
    return False


def _text(lines: list[str]) -> list[str]:
    """Return text with code spans as literals, which may touch a letter (`token`s), and with
    escaped bars.
    """
    pieces = _CODE_SPAN.split("\n".join(lines))
    for index, piece in enumerate(pieces):
        is_code = index % 2
        pieces[index] = rf"\ ``{piece}``\ " if is_code else piece.replace("|", r"\|")
    text = "".join(pieces).replace("\n\\ ``", "\n``")
    return text.removeprefix("\\ ").split("\n")


def _fence(lines: list[str]) -> list[str]:
    first, *code, _ = lines
    indent = first.partition("`")[0]
    return ["", f"{indent}.. code-block:: python", "", *(f"    {line}" for line in code), ""]


def _example(lines: list[str]) -> list[str]:
    return ["", ".. code-block:: python", "", *lines, ""]


def _table(lines: list[str]) -> list[str]:
    result = ["", ".. list-table::", "    :header-rows: 1", ""]
    for line in lines:
        if not set(line) <= set(" |-:"):
            marker = "*"
            for cell in re.split(r"(?<!\\)\|", line.strip()[1:-1]):
                result.append(f"    {marker} - {_text([cell.strip()])[0]}")
                marker = " "
    return [*result, ""]


_CONVERTERS = {
    "text": _text,
    "fence": _fence,
    "example": _example,
    "table": _table,
    "doctest": list,
}


def _process(
    _app: Any, kind: str, _name: str, _obj: object, _options: Any, lines: list[str]
) -> None:
    if kind == "method":  # functions that the facade binds: it is `self`
        lines[:] = [line for line in lines if line.strip() != "dataset: The release."]
    lines[:] = restructured(lines)
    if kind in _WITHOUT_TYPE:
        lines.insert(0, "")


def _name_arrays(
    _app: Any,
    _object_kind: str,
    _name: str,
    _obj: object,
    _options: Any,
    signature: str | None,
    result: str | None,
) -> tuple[str | None, ...]:
    texts = (signature, result)
    return tuple(text and _ARRAY.sub(_array_name, text) for text in texts)


def _array_name(array: re.Match[str]) -> str:
    return _ARRAY_NAMES.get(array["dtype"], "AnyArray")


def setup(app: Any) -> None:
    """Connect the functions that change docstrings, before napoleon, and write the reference."""
    write_reference(Path(__file__).parent / "api")
    app.setup_extension("sphinx.ext.autodoc")
    app.connect("autodoc-process-docstring", _process, priority=400)
    app.connect("autodoc-process-signature", _name_arrays)
