"""Write docs/public_names.json, the list of all public names: `python docs/make_public_names.py`.

Names are read from the text of the modules, which are not imported: so nobody needs PyTorch to make
the list or to compare it. Public are the modules that docs/conf.py lists for the reference: the
names in their `__all__`, or, if a module has none, the names that it defines without an underscore.
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
"""Module, or class that users know by its name → names of daily use."""
MAX_VALUE_LENGTH = 160
"""Letters of a constant's value that are listed."""
RECORD_BASES = {"NamedTuple", "TypedDict", "msgspec.Struct"}
"""Bases, besides the decorator `dataclass`, that make a class with fields."""


def main() -> None:
    """Write the list."""
    FILE.write_text(as_json(listed()), encoding="utf-8")


def listed() -> dict[str, Any]:
    """Return what is public now: the names of daily use, the names of each module, and the
    commands.
    """
    modules = {module: names_of(module) for module in public_modules()}
    return {"daily": daily(modules), "rooms": modules, "commands": commands()}


def as_json(names: dict[str, Any]) -> str:
    """Return the list as text, one name on each line."""
    return json.dumps(names, indent=1, ensure_ascii=False) + "\n"


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Return a line for each name that was added, removed or changed from one list to another."""
    before = _descriptions(old)
    after = _descriptions(new)
    lines = [f"removed: {name}" for name in sorted(before.keys() - after.keys())]
    lines += [f"added: {name}" for name in sorted(after.keys() - before.keys())]
    for name in sorted(before.keys() & after.keys()):
        if before[name] != after[name]:
            lines.append(f"changed: {name}\n    was {before[name]}\n    is  {after[name]}")
    return lines


def _descriptions(names: dict[str, Any]) -> dict[str, str]:
    """Return the description of every entry of a list."""
    descriptions = dict(names["commands"])
    for module, members in names["rooms"].items():
        for name, description in members.items():
            descriptions[f"{module}: {name}"] = description
    for name, use in names["daily"].items():
        descriptions[f"{name}, of daily use"] = f"in {use['page']}"
    return descriptions


# names of daily use


def daily(modules: dict[str, dict[str, str]]) -> dict[str, dict[str, str | None]]:
    """Return, for each name of daily use, the first page with code that uses it, and its
    description; None where there is none.
    """
    names_by_page = {page: used_names(TOP / page) for page in pages()}
    uses: dict[str, dict[str, str | None]] = {}
    for group, names in DAILY.items():
        module = PACKAGE if group == "DeepAccident" else _dotted(group)
        for name in names.split():
            last = name.rpartition(".")[2]
            using_pages = (page for page, used in names_by_page.items() if last in used)
            member = f"{group}.{name}" if group == "DeepAccident" else name
            uses[f"{group}.{name}".lstrip(".")] = {
                "page": next(using_pages, None),
                "is": _resolve(modules, module, member),
            }
    return uses


def _resolve(modules: dict[str, dict[str, str]], module: str, name: str) -> str | None:
    """Return the description of a name in the module that describes it."""
    description = modules[module].get(name)
    while description and description.startswith(f"= {PACKAGE}."):
        module = description.removeprefix("= ").removesuffix(f".{name}")
        description = modules[module].get(name)
    return description


def pages() -> list[str]:
    """Return the pages that users read: the pages of docs/ in the order of docs/index.md, then that
    page and README.md.
    """
    start = (TOP / "docs" / "index.md").read_text(encoding="utf-8")
    listed = [f"docs/{name}.md" for name in re.findall(r"^\w+$", start, re.MULTILINE)]
    return [*listed, "docs/index.md", "README.md"]


def code_of(page: Path) -> Iterator[ast.AST]:
    """Yield the nodes of a page's Python blocks."""
    text = page.read_text(encoding="utf-8")
    for block in re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        yield from ast.walk(ast.parse(block))


def used_names(page: Path) -> set[str]:
    """Return the names and attributes in a page's Python blocks."""
    names = set()
    for node in code_of(page):
        if isinstance(node, ast.Attribute):
            names.add(node.attr)
        elif isinstance(node, ast.Name):
            names.add(node.id)
        elif isinstance(node, ast.alias):
            names.add(node.name)
    return names


# modules


@cache
def public_modules() -> dict[str, tuple[str, ...]]:
    """Return the names that the reference lists, by module."""
    constants = _constants(TOP / "docs" / "conf.py")
    internal = ast.literal_eval(constants["INTERNAL"])
    result = {PACKAGE: _public_names(PACKAGE)}
    for listed in ast.literal_eval(constants["REFERENCE"]).values():
        for name in listed:
            parent, _, last = name.rpartition(".")
            if not last[0].isupper():
                module = _dotted(name)
                result[module] = tuple(
                    member for member in _public_names(module) if member not in internal
                )
            elif parent:
                module = _dotted(parent)
                result[module] = (*result.get(module, ()), last)
    return result


def _dotted(name: str) -> str:
    return f"{PACKAGE}.{name}".rstrip(".")


def _public_names(module: str) -> tuple[str, ...]:
    constants = _constants(_path(module))
    if "__all__" in constants:
        return tuple(ast.literal_eval(constants["__all__"]))
    names = [name for name, (home, _) in _names(module).items() if home == module]
    return tuple(name for name in names if not name.startswith("_"))


def names_of(module: str) -> dict[str, str]:
    """Return the parameters, types and values of a module's public names and of the members of its
    classes, as they are written.
    """
    result: dict[str, str] = {}
    for name in public_modules()[module]:
        home, node = _definition(module, name)
        describing_module = _describing_module(home, name)
        if describing_module != module:
            result[name] = f"= {describing_module}.{name}"
        elif isinstance(node, ast.ClassDef):
            result[name] = f"class{_public_bases(home, node)} {_constructor(home, node)}"
            for member, description in _members(home, node).items():
                result[f"{name}.{member}"] = description
        else:
            result[name] = _describe(home, node)
    return result


@cache
def _describing_module(home: str, name: str) -> str:
    """Return the public module that describes a name: the nearest above its home, or the first that
    has it.
    """
    modules = [
        module
        for module, names in public_modules().items()
        if name in names and _definition(module, name)[0] == home
    ]
    above = [module for module in modules if f"{home}.".startswith(f"{module}.")]
    nearest = max(above, key=len, default=PACKAGE)
    return modules[0] if nearest == PACKAGE else nearest


# the text of a module


@cache
def _path(module: str) -> Path:
    path = TOP / module.replace(".", "/")
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


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
    """Yield the statements of a module or class, and the ones below an `if` or a `try`."""
    for node in body:
        if isinstance(node, ast.If | ast.Try):
            yield from _statements(node.body)
        else:
            yield node


@cache
def _names(module: str) -> dict[str, tuple[str, ast.stmt | str]]:
    """Return where each name comes from: this module and the statement, or another module and the
    name there.
    """
    origins: dict[str, tuple[str, ast.stmt | str]] = {}
    for node in _statements(_tree(_path(module)).body):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):  # of overloads the last
            origins[node.name] = (module, node)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                # a function that is wrapped stays itself
                origins.setdefault(ast.unparse(target), (module, node))
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                origins[alias.asname or alias.name] = (node.module, alias.name)
    return origins


@cache
def _definition(module: str, name: str) -> tuple[str, ast.stmt]:
    """Return the devkit's module that defines a name of this one, and the statement; raises
    AttributeError.
    """
    if name not in _names(module):
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    home, origin = _names(module)[name]
    return _definition(home, origin) if isinstance(origin, str) else (home, origin)


def _describe(module: str, node: ast.stmt, *, bound: bool = False) -> str:
    """Return a function's parameters and result, or a constant's type or value; `bound` leaves the
    first parameter out.
    """
    if isinstance(node, ast.FunctionDef):
        parameters = _with_values(module, node.args)
        if bound:
            (parameters.posonlyargs or parameters.args).pop(0)
        return f"({_text(parameters)}) -> {ast.unparse(node.returns or ast.Name('None'))}"
    if isinstance(node, ast.AnnAssign) and ast.unparse(node.annotation) != "Final":
        return f": {ast.unparse(node.annotation)}"
    if module.endswith(".version"):
        return ": str"  # the value changes with each release
    value = ""
    if isinstance(node, ast.Assign | ast.AnnAssign) and node.value:
        value = _text(node.value)
    if len(value) > MAX_VALUE_LENGTH:
        value = f"{value[:MAX_VALUE_LENGTH]}…"
    return f"= {value}"


def _with_values(module: str, parameters: ast.arguments) -> ast.arguments:
    """Return a copy in which defaults that are private constants of the module are their values."""

    def value(default: ast.expr | None) -> ast.expr | None:
        if isinstance(default, ast.Name) and default.id.startswith("_"):
            _, node = _definition(module, default.id)
            return node.value if isinstance(node, ast.Assign | ast.AnnAssign) else default
        return default

    result = deepcopy(parameters)
    result.defaults = list(filter(None, map(value, parameters.defaults)))
    result.kw_defaults = list(map(value, parameters.kw_defaults))
    return result


def _bases(module: str, node: ast.ClassDef) -> Iterator[tuple[str, ast.ClassDef]]:
    """Yield a class, and the devkit's classes that it inherits from."""
    yield module, node
    for base in node.bases:
        definition = _devkit_class(module, base)
        if definition:
            yield from _bases(*definition)


def _devkit_class(module: str, base: ast.expr) -> tuple[str, ast.ClassDef] | None:
    """Return the module and the statement of a base; None if it is not the devkit's."""
    name = ast.unparse(base.value if isinstance(base, ast.Subscript) else base)
    home, _ = _names(module).get(name, ("", ""))
    if not home.startswith(PACKAGE):
        return None
    home, node = _definition(module, name)
    return (home, node) if isinstance(node, ast.ClassDef) else None


@cache
def _is_public(node: ast.ClassDef) -> bool:
    for module, names in public_modules().items():
        if node.name in names and _definition(module, node.name)[1] is node:
            return True
    return False


def _public_bases(module: str, node: ast.ClassDef) -> str:
    bases = []
    for base in node.bases:
        definition = _devkit_class(module, base)
        if definition is None or _is_public(definition[1]):
            bases.append(ast.unparse(base))
    return f"({', '.join(bases)})" if bases else ""


class _OmitComputations(ast.NodeTransformer):
    """Transformer that leaves out computed values, which not every Python version writes alike."""

    def visit(self, node: ast.AST) -> ast.AST:
        computes = isinstance(
            node, ast.Lambda | ast.GeneratorExp | ast.ListComp | ast.SetComp | ast.DictComp
        )
        return ast.Name("…") if computes else self.generic_visit(node)


def _text(node: ast.AST) -> str:
    return ast.unparse(_OmitComputations().visit(deepcopy(node)))


def _decorators(node: ast.FunctionDef | ast.ClassDef) -> str:
    return " ".join(map(ast.unparse, node.decorator_list))


def _constructor(module: str, node: ast.ClassDef) -> str:
    """Return a class's parameters: the parameters of `__init__`, or the fields of a record."""
    classes = list(_bases(module, node))
    is_record = any(_is_record(base) for _, base in classes)
    fields: dict[str, str] = {}
    for home, base in reversed(classes):
        for statement in base.body:
            if isinstance(statement, ast.FunctionDef) and statement.name == "__init__":
                parameters, _, _ = _describe(home, statement, bound=True).rpartition(" -> ")
                fields = {"": parameters[1:-1]}
            elif isinstance(statement, ast.AnnAssign) and is_record and _is_parameter(statement):
                fields[ast.unparse(statement.target)] = _text(statement)
    return f"({', '.join(fields.values())})"


def _is_record(node: ast.ClassDef) -> bool:
    bases = set(map(ast.unparse, node.bases))
    return "dataclass" in _decorators(node) or not RECORD_BASES.isdisjoint(bases)


def _is_parameter(field: ast.AnnAssign) -> bool:
    text = ast.unparse(field)
    return not (text.startswith("_") or "ClassVar" in text or "init=False" in text)


def _members(module: str, node: ast.ClassDef) -> dict[str, str]:
    """Return a class's public methods, properties and attributes, with the members of its bases
    that are not public themselves.
    """
    result: dict[str, str] = {}
    for base in node.bases:
        definition = _devkit_class(module, base)
        if definition and not _is_public(definition[1]):
            result |= _members(*definition)
    for statement in _statements(node.body):
        if isinstance(statement, ast.FunctionDef):
            name = statement.name
            describe = _describe_method
        elif isinstance(statement, ast.Assign):
            name = ast.unparse(statement.targets[0])
            describe = _describe_attribute
        else:
            continue
        if not name.startswith("_"):
            result[name] = describe(module, statement)
    return result


def _describe_method(module: str, node: ast.FunctionDef) -> str:
    decorators = _decorators(node)
    if "property" in decorators:
        return f": {ast.unparse(node.returns or ast.Name('None'))}"
    return _describe(module, node, bound="staticmethod" not in decorators)


def _describe_attribute(module: str, node: ast.Assign) -> str:
    """Return the description of a class attribute: a value, or a function of another module that is
    its method.
    """
    value = node.value
    if isinstance(value, ast.Attribute) and isinstance(value.value, ast.Name):
        package, name = _names(module).get(value.value.id, ("", ""))
        if isinstance(name, str) and package.startswith(PACKAGE):
            home, function = _definition(f"{package}.{name}", value.attr)
            return _describe(home, function, bound=True)
    return _describe(module, node)


# commands


def commands(group: click.Group = deepaccident, *path: str) -> dict[str, str]:
    """Return the arguments and options of all commands."""
    context = click.Context(group)
    result = {}
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        visible = [
            parameter for parameter in command.params if not getattr(parameter, "hidden", False)
        ]
        words = ("deepaccident", *path, name)
        result[" ".join(words)] = " ".join(map(_parameter, visible))
        if isinstance(command, click.Group):
            result |= commands(command, *path, name)
    return result


def _parameter(parameter: click.Parameter) -> str:
    if isinstance(parameter, click.Argument):
        return str(parameter.name).upper()
    return "/".join((*parameter.opts, *parameter.secondary_opts))


if __name__ == "__main__":
    main()
