"""Write docs/public_names.json, the list of all that is public: `python docs/make_public_names.py`.

Names are read from the text of the modules, not imported: so nobody needs PyTorch to make the list
    or to compare it.
Public are the modules that docs/conf.py lists for the reference: what is in their `__all__`, or,
where a module has none, what it defines without an underscore.
"""

import ast
import json
import re
from collections.abc import Iterable, Iterator
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli import deepaccident

TOP = Path(__file__).parents[1]
FILE = TOP / "docs" / "public_names.json"
PACKAGE = "deepaccident_devkit"
DAILY = {
    "": "DeepAccident",
    "DeepAccident": (
        "find scenario sample get_sample samples training_samples evaluation_samples "
        "split_scenarios get_boxes boxes "
        "camera load_image load_point_cloud local_path world_from transform "
        "map_pointcloud_to_image "
        "aggregate_point_cloud cooperative_boxes collision motion_labels findings "
        "describe interactions town_map "
        "render_sample render_bev"
    ),
    "geometry": "BevGrid Box.category Box.center Boxes.yaw",
    "taxonomy": "CATEGORIES",
    "release": "find_release read_label read_meta read_calib read_lidar",
    "motion": "MotionLabelConfig LabelFiles write_label_files predict_instances",
    "evaluation": (
        "Accident DetectedBoxes MotionOutput ResultsWriter instances_of "
        "AccidentEvaluator DetectionEvaluator "
        "MotionEvaluator WarningEvaluator breakdown"
    ),
    "evaluation.results": "read_results",
    "evaluation.runs": "evaluate_results save_run verify_bundle compare_bundles",
    "plugins.baselines": "predict_accidents predict_detections predict_motion",
    "training.torch": "V2XDataset V2XConfig ImageConfig collate",
    "export.bulk": "export_release",
    "collisions": "accident_of outcomes_of",
    "descriptions": "avoidability",
    "plugins.safety": "lead_times safety_report twin_diff",
    "plugins.safety.page": "save_safety_report",
    "validation": "release_completeness",
    "plugins.nuscenes": "open_nuscenes",
    "plugins.synth": "SynthConfig make_release",
    "testing": "write_small_release broken_release",
}
"""Room, or the class that users know by its name → the names of daily use."""
MOST = 80
"""Names of daily use at most."""
LONGEST = 160
"""Letters of a constant's value that are kept."""
RECORDS = {"NamedTuple", "TypedDict", "msgspec.Struct"}
"""What makes a class with fields of one, beside `dataclass`."""


def main() -> None:
    """Write the list."""
    FILE.write_text(as_json(listed()), encoding="utf-8")


def listed() -> dict[str, Any]:
    """What is public now: the names of daily use, those of each room, and the commands."""
    rooms = {room: names_of(room) for room in public_modules()}
    return {"daily": daily(rooms), "rooms": rooms, "commands": commands()}


def as_json(names: dict[str, Any]) -> str:
    """The list as text, one name a line."""
    return json.dumps(names, indent=1, ensure_ascii=False) + "\n"


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """A line for each name that was added, removed or changed, from one list to another."""
    before, after = _lines(old), _lines(new)
    changed = [name for name in before.keys() & after.keys() if before[name] != after[name]]
    return [
        *(f"removed: {name}" for name in sorted(before.keys() - after.keys())),
        *(f"added: {name}" for name in sorted(after.keys() - before.keys())),
        *(
            f"changed: {name}\n    was {before[name]}\n    is  {after[name]}"
            for name in sorted(changed)
        ),
    ]


def _lines(names: dict[str, Any]) -> dict[str, str]:
    return {
        **{
            f"{room}: {name}": said
            for room, each in names["rooms"].items()
            for name, said in each.items()
        },
        **names["commands"],
        **{
            f"{name}, of daily use": f"in {found['page']}" for name, found in names["daily"].items()
        },
    }


# names of daily use


def daily(rooms: dict[str, dict[str, str]]) -> dict[str, dict[str, str | None]]:
    """Names of daily use → the first page whose code uses them, and what they are; None where there
    is none.
    """
    uses = {page: used_names(TOP / page) for page in pages()}
    found: dict[str, dict[str, str | None]] = {}
    for group, names in DAILY.items():
        for name in names.split():
            page = next(
                (page for page, used in uses.items() if name.rpartition(".")[2] in used), None
            )
            room, whole = (
                (PACKAGE, f"{group}.{name}") if group == "DeepAccident" else (_dotted(group), name)
            )
            while (said := rooms[room].get(whole, "")).startswith(f"= {PACKAGE}."):
                room = said.removeprefix("= ").removesuffix(f".{whole}")
            found[f"{group}.{name}".lstrip(".")] = {"page": page, "is": said or None}
    return found


def pages() -> list[str]:
    """The pages that users read: those of docs/ in the order of docs/index.md, then this one and
    README.md.
    """
    start = (TOP / "docs" / "index.md").read_text(encoding="utf-8")
    listed = [f"docs/{name}.md" for name in re.findall(r"^\w+$", start, re.MULTILINE)]
    return [*listed, "docs/index.md", "README.md"]


def code_of(page: Path) -> Iterator[ast.AST]:
    """The nodes of a page's Python blocks."""
    for block in re.findall(
        r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    ):
        yield from ast.walk(ast.parse(block))


def used_names(page: Path) -> set[str]:
    """Names and attributes in a page's Python blocks."""
    nodes = [*code_of(page)]
    return (
        {node.attr for node in nodes if isinstance(node, ast.Attribute)}
        | {node.id for node in nodes if isinstance(node, ast.Name)}
        | {node.name for node in nodes if isinstance(node, ast.alias)}
    )


# rooms


@cache
def public_modules() -> dict[str, tuple[str, ...]]:
    """Module → the names in it that the reference lists."""
    constants = _constants(TOP / "docs" / "conf.py")
    internal = ast.literal_eval(constants["INTERNAL"])
    result = {PACKAGE: _all_of(PACKAGE)}
    for listed in ast.literal_eval(constants["REFERENCE"]).values():
        for name in listed:
            room, _, last = name.rpartition(".")
            if not last[0].isupper():
                result[_dotted(name)] = tuple(
                    each for each in _all_of(_dotted(name)) if each not in internal
                )
            elif room:
                result[_dotted(room)] = (*result.get(_dotted(room), ()), last)
    return result


def _dotted(room: str) -> str:
    return f"{PACKAGE}.{room}".rstrip(".")


def _all_of(module: str) -> tuple[str, ...]:
    if "__all__" in (constants := _constants(_path(module))):
        return tuple(ast.literal_eval(constants["__all__"]))
    return tuple(
        name
        for name, (home, _) in _names(module).items()
        if home == module and not name.startswith("_")
    )


def names_of(room: str) -> dict[str, str]:
    """A room's public names and the members of its classes → parameters, types, values, as they are
    written.
    """
    result: dict[str, str] = {}
    for name in public_modules()[room]:
        module, node = _found(room, name)
        owner = _describing(module, name)
        if owner != room:
            result[name] = f"= {owner}.{name}"
        elif isinstance(node, ast.ClassDef):
            result[name] = f"class{_public_bases(module, node)} {_constructor(module, node)}"
            result |= {f"{name}.{member}": said for member, said in _members(module, node).items()}
        else:
            result[name] = _said(module, node)
    return result


@cache
def _describing(home: str, name: str) -> str:
    """Of the rooms that have a name, the one that describes it: the nearest above its module, or
    the first.
    """
    rooms = [
        room
        for room, names in public_modules().items()
        if name in names and _found(room, name)[0] == home
    ]
    near = [room for room in rooms if f"{home}.".startswith(f"{room}.") and room != PACKAGE]
    return max(near, key=len, default=rooms[0])


# the text of a module


@cache
def _path(module: str) -> Path:
    place = TOP / module.replace(".", "/")
    return place / "__init__.py" if place.is_dir() else place.with_suffix(".py")


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def _constants(path: Path) -> dict[str, ast.expr]:
    return {
        ast.unparse(node.targets[0]): node.value
        for node in _tree(path).body
        if isinstance(node, ast.Assign)
    }


def _statements(body: Iterable[ast.stmt]) -> Iterator[ast.stmt]:
    """Those of a module or class, and those below an `if` or a `try`."""
    for node in body:
        if isinstance(node, ast.If | ast.Try):
            yield from _statements(node.body)
        else:
            yield node


@cache
def _names(module: str) -> dict[str, tuple[str, ast.stmt | str]]:
    """Name → where it comes from: this module and the statement, or another module and the name
    there.
    """
    found: dict[str, tuple[str, ast.stmt | str]] = {}
    for node in _statements(_tree(_path(module)).body):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):  # of overloads the last
            found[node.name] = (module, node)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                found.setdefault(
                    ast.unparse(target), (module, node)
                )  # a function that is wrapped stays itself
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {alias.asname or alias.name: (node.module, alias.name) for alias in node.names}
    return found


@cache
def _found(module: str, name: str) -> tuple[str, ast.stmt]:
    """The module of the devkit that defines a name of this one, and the statement; raises
    AttributeError.
    """
    if name not in _names(module):
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    home, there = _names(module)[name]
    return _found(home, there) if isinstance(there, str) else (home, there)


def _said(module: str, node: ast.stmt, *, bound: bool = False) -> str:
    """A function's parameters and result, or a constant's type or value; `bound` leaves the first
    parameter out.
    """
    if isinstance(node, ast.FunctionDef):
        parameters = _with_values(module, node.args)
        if bound:
            (parameters.posonlyargs or parameters.args).pop(0)
        return f"({_text(parameters)}) -> {ast.unparse(node.returns or ast.Name('None'))}"
    if isinstance(node, ast.AnnAssign) and ast.unparse(node.annotation) != "Final":
        return f": {ast.unparse(node.annotation)}"
    value = _text(node.value) if isinstance(node, ast.Assign | ast.AnnAssign) and node.value else ""
    if module.endswith(".version"):
        return ": str"  # which a release changes
    return f"= {value}" if len(value) <= LONGEST else f"= {value[:LONGEST]}…"


def _with_values(module: str, parameters: ast.arguments) -> ast.arguments:
    """A copy in which defaults that are private constants of the module are their values."""

    def value(default: ast.expr | None) -> ast.expr | None:
        if isinstance(default, ast.Name) and default.id.startswith("_"):
            node = _found(module, default.id)[1]
            return node.value if isinstance(node, ast.Assign | ast.AnnAssign) else default
        return default

    copied = deepcopy(parameters)
    copied.defaults = [each for each in map(value, parameters.defaults) if each]
    copied.kw_defaults = [*map(value, parameters.kw_defaults)]
    return copied


def _bases(module: str, node: ast.ClassDef) -> Iterator[tuple[str, ast.ClassDef]]:
    """A class, and those of the devkit that it inherits from."""
    yield module, node
    for base in node.bases:
        if found := _of_devkit(module, base):
            yield from _bases(*found)


def _of_devkit(module: str, base: ast.expr) -> tuple[str, ast.ClassDef] | None:
    """The module and the statement of a base; None where it is not the devkit's."""
    name = ast.unparse(base.value if isinstance(base, ast.Subscript) else base)
    home, there = _names(module).get(name, ("", ""))
    if not home.startswith(PACKAGE):
        return None
    home, node = _found(home, there) if isinstance(there, str) else (home, there)
    return (home, node) if isinstance(node, ast.ClassDef) else None


@cache
def _is_public(node: ast.ClassDef) -> bool:
    rooms = public_modules().items()
    return any(node.name in names and _found(room, node.name)[1] is node for room, names in rooms)


def _public_bases(module: str, node: ast.ClassDef) -> str:
    bases = [(base, _of_devkit(module, base)) for base in node.bases]
    shown = [ast.unparse(base) for base, found in bases if found is None or _is_public(found[1])]
    return f"({', '.join(shown)})" if shown else ""


class _Short(ast.NodeTransformer):
    """Leaves out what computes a value, which not every Python writes alike."""

    def visit(self, node: ast.AST) -> ast.AST:
        computes = isinstance(
            node, ast.Lambda | ast.GeneratorExp | ast.ListComp | ast.SetComp | ast.DictComp
        )
        return ast.Name("…") if computes else self.generic_visit(node)


def _text(node: ast.AST) -> str:
    return ast.unparse(_Short().visit(deepcopy(node)))


def _decorators(node: ast.FunctionDef | ast.ClassDef) -> str:
    return " ".join(map(ast.unparse, node.decorator_list))


def _constructor(module: str, node: ast.ClassDef) -> str:
    """Its parameters: those of `__init__`, or the fields of a record."""
    bases = [*_bases(module, node)][::-1]
    record = any(
        "dataclass" in _decorators(each) or RECORDS.intersection(map(ast.unparse, each.bases))
        for _, each in bases
    )
    fields: dict[str, str] = {}
    for home, each in bases:
        for statement in each.body:
            if isinstance(statement, ast.FunctionDef) and statement.name == "__init__":
                fields = {"": _said(home, statement, bound=True).rpartition(" -> ")[0][1:-1]}
            elif isinstance(statement, ast.AnnAssign) and record and _is_parameter(statement):
                fields[ast.unparse(statement.target)] = _text(statement)
    return f"({', '.join(fields.values())})"


def _is_parameter(field: ast.AnnAssign) -> bool:
    text = ast.unparse(field)
    return not (text.startswith("_") or "ClassVar" in text or "init=False" in text)


def _members(module: str, node: ast.ClassDef) -> dict[str, str]:
    """Its public methods, properties and class attributes, with those of its bases that are not
    public themselves.
    """
    result: dict[str, str] = {}
    for base in node.bases:
        if (found := _of_devkit(module, base)) and not _is_public(found[1]):
            result |= _members(*found)
    for statement in _statements(node.body):
        if isinstance(statement, ast.FunctionDef) and not statement.name.startswith("_"):
            result[statement.name] = _member(module, statement)
        elif isinstance(statement, ast.Assign) and not (
            name := ast.unparse(statement.targets[0])
        ).startswith("_"):
            result[name] = _attribute(module, statement)
    return result


def _member(module: str, node: ast.FunctionDef) -> str:
    kinds = _decorators(node)
    if "property" in kinds:
        return f": {ast.unparse(node.returns or ast.Name('None'))}"
    return _said(module, node, bound="staticmethod" not in kinds)


def _attribute(module: str, node: ast.Assign) -> str:
    """That of a class: a value, or a function of another module that is its method."""
    value = node.value
    if isinstance(value, ast.Attribute) and isinstance(value.value, ast.Name):
        package, name = _names(module).get(value.value.id, ("", ""))
        if isinstance(name, str) and package.startswith(PACKAGE):
            return _said(*_found(f"{package}.{name}", value.attr), bound=True)
    return _said(module, node)


# commands


def commands(group: click.Group = deepaccident, *path: str) -> dict[str, str]:
    """Commands → their arguments and options."""
    context, result = click.Context(group), {}
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        words = ("deepaccident", *path, name)
        result[" ".join(words)] = " ".join(
            _parameter(each) for each in command.params if not getattr(each, "hidden", False)
        )
        if isinstance(command, click.Group):
            result |= commands(command, *path, name)
    return result


def _parameter(parameter: click.Parameter) -> str:
    if isinstance(parameter, click.Argument):
        return str(parameter.name).upper()
    return "/".join((*parameter.opts, *parameter.secondary_opts))


if __name__ == "__main__":
    main()
