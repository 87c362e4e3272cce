"""The documentation site: the guides as they lie in the repository, and an API reference from the
docstrings.

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
html_additional_pages = {"index": "to_docs.html"}  # for those who open the folder
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
        "evaluation.motion",
        "evaluation.accident",
        "evaluation.detection",
        "evaluation.warning",
        "evaluation.planning",
        "evaluation.forecasting",
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
        "export.parquet.Parquet",
        "export.webdataset.WebDataset",
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
"""Title of a page → what it lists: modules, classes, a type."""
INTERNAL = ("MOST_QUOTED", "MOST_SAID", "MOST_TOLD", "escaped", "shortened")
"""What no page lists, of modules without `__all__`."""
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
    """Write the pages of the reference; they are not kept in the repository."""
    folder.mkdir(exist_ok=True)
    seen: set[str] = set()
    names = []
    for title, listed in REFERENCE.items():
        names.append(re.sub(r"\W+", "_", title.lower()))
        sections = "\n".join(
            f"## `{each}`\n\n```{{eval-rst}}\n{_directive(each, seen)}\n```\n" for each in listed
        )
        (folder / f"{names[-1]}.md").write_text(f"# {title}\n\n{sections}", encoding="utf-8")
    tree = "\n".join(["```{toctree}", ":maxdepth: 2", "", *names, "```", ""])
    (folder / "index.md").write_text(f"{INTRODUCTION}\n{tree}", encoding="utf-8")


def _directive(name: str, seen: set[str]) -> str:
    """What autodoc takes of a module, without names that stand on an earlier page; of a class or a
    type.
    """
    path = f"deepaccident_devkit.{name}"
    if name == "DeepAccident":
        return f".. autoclass:: {path}\n   :members:\n   :inherited-members:"
    if name.rpartition(".")[2][0].isupper():
        return f".. {'autodata' if name.endswith('Layer') else 'autoclass'}:: {path}"
    try:
        public = getattr(import_module(path), "__all__", None)
    except MissingExtraError:  # autodoc mocks what it lacks
        return f".. automodule:: {path}\n   :members:\n   :imported-members:"
    if public is None:
        return f".. automodule:: {path}\n   :members:\n   :exclude-members: {', '.join(INTERNAL)}"
    members = [each for each in public if each not in seen]
    seen.update(public)
    shown = f"\n   :members: {', '.join(members)}" if members else ""  # an empty list would be all
    return f".. automodule:: {path}{shown}\n   :imported-members:"


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
"""As `deepaccident_devkit.support.arrays` calls them."""
_WITHOUT_TYPE = ("attribute", "data", "property")
"""What napoleon takes `type: text` off, if there is a colon in the first line."""
_SECTIONS = ("Args:", "Attributes:", "Examples:", "Raises:", "Returns:", "Yields:")


def restructured(lines: list[str]) -> list[str]:
    """A docstring's lines as reStructuredText; doctests, and the sections that napoleon takes
    apart, stay.
    """
    result: list[str] = []
    block: list[str] = []
    kind = "text"
    for number, line in enumerate(lines):
        following = _kind(line, kind, lines[:number])
        if following != kind:
            result += _RESTRUCTURED[kind](block) if block else []
            kind, block = following, []
        block.append(line)
    return result + _RESTRUCTURED[kind](block)


def _kind(line: str, kind: str, before: list[str]) -> str:
    """What a line belongs to: `fence`, `table`, `doctest`, `example` (indented code) or `text`."""
    words = line.strip()
    if kind == "fence" and before[-1].strip() != "```":
        return "fence"
    if words.startswith("```"):
        return "fence"
    if words.startswith("|") and words.endswith("|"):
        return "table"
    if words.startswith(">>>") or (kind == "doctest" and words):
        return "doctest"
    indented = line.startswith("    ")
    if kind == "example":
        return "example" if indented or not words else "text"
    starts_block = not before or not before[-1].strip()
    return "example" if indented and starts_block and not _in_section(before) else "text"


def _in_section(before: list[str]) -> bool:
    """Whether the last line that is not indented begins a section."""
    outermost = next((line for line in reversed(before) if line and not line.startswith(" ")), "")
    return outermost in _SECTIONS


def _text(lines: list[str]) -> list[str]:
    """Code spans as literals, which may touch a letter (`token`s); bars are bars."""
    pieces = _CODE_SPAN.split("\n".join(lines))
    pieces[::2] = [piece.replace("|", r"\|") for piece in pieces[::2]]
    pieces[1::2] = [rf"\ ``{piece}``\ " for piece in pieces[1::2]]
    return "".join(pieces).replace("\n\\ ``", "\n``").removeprefix("\\ ").split("\n")


def _fence(lines: list[str]) -> list[str]:
    indent = lines[0][: len(lines[0]) - len(lines[0].lstrip())]
    return ["", f"{indent}.. code-block:: python", "", *(f"    {line}" for line in lines[1:-1]), ""]


def _example(lines: list[str]) -> list[str]:
    return ["", ".. code-block:: python", "", *lines, ""]


def _table(lines: list[str]) -> list[str]:
    rows = [re.split(r"(?<!\\)\|", line.strip()[1:-1]) for line in lines]
    result = ["", ".. list-table::", "    :header-rows: 1", ""]
    for row in (row for row in rows if set("".join(row)) - set(" -:")):
        cells = [_text([cell.strip()])[0] for cell in row]
        result += [f"    {'*' if not index else ' '} - {cell}" for index, cell in enumerate(cells)]
    return [*result, ""]


_RESTRUCTURED = {
    "text": _text,
    "fence": _fence,
    "example": _example,
    "table": _table,
    "doctest": list,
}


def _process(
    _app: Any, what: str, _name: str, _obj: object, _options: Any, lines: list[str]
) -> None:
    if what == "method":  # functions that the facade binds: it is `self`
        lines[:] = [line for line in lines if line.strip() != "dataset: the release."]
    lines[:] = restructured(lines)
    if what in _WITHOUT_TYPE:
        lines.insert(0, "")


def _name_arrays(
    _app: Any,
    _what: str,
    _name: str,
    _obj: object,
    _options: Any,
    signature: str | None,
    result: str | None,
) -> tuple[str | None, ...]:
    return tuple(text and _ARRAY.sub(_array_name, text) for text in (signature, result))


def _array_name(found: re.Match[str]) -> str:
    return _ARRAY_NAMES.get(found["dtype"], "AnyArray")


def setup(app: Any) -> None:
    """Connect what reads docstrings, ahead of napoleon, and write the reference."""
    write_reference(Path(__file__).parent / "api")
    app.setup_extension("sphinx.ext.autodoc")
    app.connect("autodoc-process-docstring", _process, priority=400)
    app.connect("autodoc-process-signature", _name_arrays)
