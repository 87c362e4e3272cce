"""Values of a scenario file with their lines, checked against the types of the model's dataclasses."""

from __future__ import annotations

import dataclasses
import re
import types
from collections.abc import Mapping
from dataclasses import dataclass
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Final,
    Literal,
    TypeAlias,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from deepaccident_devkit.errors import ConfigError, shortened
from deepaccident_devkit.plugins.synth.spec.model import (
    AllOf,
    Bounds,
    FieldChoice,
    Fixed,
    OneOf,
    Part,
    Range,
    key_of,
)
from deepaccident_devkit.support.text import meant_text, spelled

if TYPE_CHECKING:
    import yaml

# The tags that PyYAML gives to plain values by itself.
_PLAIN_TAGS: Final = tuple(
    f"tag:yaml.org,2002:{name}"
    for name in ("map", "seq", "str", "int", "float", "bool", "null", "timestamp")
)
# YAML 1.1 also reads 010 as eight, 1:30 as ninety and 1_0 as ten, which few expect.
_DECIMAL: Final = re.compile(
    r"[-+]?(\.inf|\.nan|(0|[1-9]\d*)(\.\d*)?([eE][-+]?\d+)?|\.\d+)", re.IGNORECASE
)
# The type of a plain word of YAML: a string, a number, a boolean, None; or something that fits no field.
Scalar: TypeAlias = object


@dataclass(frozen=True, slots=True)
class Node:
    """A value and its line.

    Attributes:
        where: such as `mine.yaml:12`; for the value of a key, the line of the key.
        value: a scalar, the entries of a mapping, or the items of a list.
    """

    where: str
    value: Scalar | Mapping[str, Node] | tuple[Node, ...]


def parse_yaml(text: str, source: str) -> Node:
    """The tree of a YAML text: one document, without tags, anchors or aliases; `source` is its name in messages.

    Raises ConfigError, with line, path and remedy: it is empty or no YAML, or has a repeated key, a key that is no
    word, an alias, a tag, or a number that is not decimal.
    """
    import yaml

    try:
        loader = yaml.SafeLoader(text)
        root = loader.get_single_node()
        if root is None:
            raise ConfigError(
                f"{source}: is empty; write at least the actors ego and other (docs/synth.md)"
            )
        return _Tree(source, loader).node(root, root.start_mark.line)
    except yaml.MarkedYAMLError as error:
        raise ConfigError(f"{source}:{_fault(error)}") from error
    except (yaml.YAMLError, RecursionError) as error:
        told = shortened(str(error).splitlines()[0])
        raise ConfigError(f"{source}: no YAML: {told}; write it again as plain text") from error


def _fault(error: yaml.MarkedYAMLError) -> str:
    """The message from the line's number on; PyYAML often finds a fault only some lines after the real one."""
    marks = [mark for mark in (error.problem_mark, error.context_mark) if mark]
    lines = list(dict.fromkeys(mark.line + 1 for mark in marks)) or [1]
    began = f", or line {lines[-1]}, where the faulty part begins" if len(lines) > 1 else ""
    told = shortened(str(error.problem))
    return f"{lines[0]}: no YAML: {told}; correct that line{began}: its quotes, brackets or indent (no tabs)"


class _Tree:
    """Makes our nodes from PyYAML's, each once; a node that comes a second time is an alias."""

    def __init__(self, source: str, loader: yaml.SafeLoader) -> None:
        self._source = source
        self._loader = loader
        self._seen: set[int] = set()

    def node(self, raw: yaml.Node, line: int, path: str = "") -> Node:
        """A node and all in it; `path` is its place, such as `actors[1]`."""
        import yaml

        where = f"{self._source}:{line + 1}"
        if id(raw) in self._seen:
            raise self._error(line, path, "aliases (*name) are not read here; write the value out")
        self._seen.add(id(raw))
        if not raw.tag.startswith(_PLAIN_TAGS):
            raise self._error(
                line, path, f"tags ({shortened(raw.tag)}) are not read here; leave the tag out"
            )
        if isinstance(raw, yaml.MappingNode):
            return Node(where, self._entries(raw, path))
        if isinstance(raw, yaml.SequenceNode):
            items = enumerate(raw.value)
            return Node(
                where,
                tuple(self.node(item, item.start_mark.line, f"{path}[{k}]") for k, item in items),
            )
        return Node(where, self._scalar(raw, line, path))

    def _scalar(self, raw: yaml.Node, line: int, path: str) -> Scalar:
        try:
            value = self._loader.construct_object(raw)
        except (
            ValueError,
            LookupError,
            AttributeError,
            OverflowError,
        ) as error:  # of PyYAML, if a tag does not fit
            told = shortened(str(error))
            sentence = (
                f"{raw.value[:40]!r} cannot be read ({told}); put it in quotes if it is a word"
            )
            raise self._error(line, path, sentence) from error
        if (
            isinstance(value, int | float)
            and not isinstance(value, bool)
            and not _DECIMAL.fullmatch(raw.value)
        ):
            found = f"{shortened(raw.value)!r} is not a plain decimal number"
            raise self._error(
                line, path, f"{found}; write one, or put it in quotes if it is a word"
            )
        return value

    def _entries(self, raw: yaml.MappingNode, path: str) -> dict[str, Node]:
        entries: dict[str, Node] = {}
        for raw_key, raw_value in raw.value:
            key, line = raw_key.value, raw_key.start_mark.line
            if not isinstance(key, str):
                raise self._error(
                    line,
                    path,
                    "expected a key that is a word, found a list or mapping; write a word",
                )
            inner = f"{path}.{key}" if path else key
            if key in entries:
                raise self._error(line, inner, "is there twice; keep one of them")
            entries[key] = self.node(raw_value, line, inner)
        return entries

    def _error(self, line: int, path: str, sentence: str) -> ConfigError:
        parts = (f"{self._source}:{line + 1}", shortened(path), sentence)
        return ConfigError(": ".join(part for part in parts if part))


# Fields with one value, no range or list of choices: they decide which other fields the file needs.
_SETTLED = {"name", "design", "exchange", "role"}
# All numbers of a scenario are smaller.
_MOST = 1e9
# The most characters of a found value that a message shows.
_SHOWN_LENGTH = 80


@dataclass(frozen=True, slots=True)
class FieldType:
    """The possible values of a field of the model.

    Attributes:
        base: `str`, `bool`, `int`, `float`, a dataclass, or `tuple` for a list.
        optional: whether it can be null.
        words: the possible words; empty for a free text.
        bounds: the bounds of a number.
        items: of a list, the type of its items.
        length: of a list, its length; None if any length is possible.
    """

    base: type[Any]
    optional: bool = False
    words: tuple[str, ...] = ()
    bounds: Bounds | None = None
    items: FieldType | None = None
    length: int | None = None


def field_types(kind: type[Any]) -> dict[str, FieldType]:
    """Field name → type, of a dataclass of the model."""
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: _field_type(hints[field.name]) for field in dataclasses.fields(kind)}


def required_fields(kind: type[Any]) -> tuple[str, ...]:
    """The fields of a dataclass that have no default."""
    missing = dataclasses.MISSING
    fields = dataclasses.fields(kind)
    return tuple(
        field.name
        for field in fields
        if field.default is missing and field.default_factory is missing
    )


def read_part(node: Node, kind: type[Any], path: str = "") -> Part:
    """A part of a scenario, from a mapping.

    Raises ConfigError: it is no mapping, has an unknown key, lacks a required one, or a value does not fit its field.
    """
    entries = node.value
    if not isinstance(entries, Mapping):
        raise _wrong(node, path or "the file", "keys and values", node)
    types_of = field_types(kind)
    names = {key_of(name): name for name in types_of}
    prefix = f"{path}." if path else ""
    for key, entry in entries.items():
        if key not in names:
            possible = f"possible: {', '.join(names)}{meant_text(key, names)}"
            raise ConfigError(f"{entry.where}: {prefix}{shortened(key)}: no such field; {possible}")
    for name in required_fields(kind):
        if key_of(name) not in entries:
            raise ConfigError(f"{node.where}: {prefix}{key_of(name)}: is missing; add it")
    present = [(key, name) for key, name in names.items() if key in entries]
    fields = {
        name: _read(entries[key], types_of[name], prefix + key, settled=name in _SETTLED)
        for key, name in present
    }
    return Part(kind, node.where, path, fields, {name: entries[key].where for key, name in present})


def _field_type(hint: Any) -> FieldType:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        (inner,) = (argument for argument in arguments if argument is not type(None))
        return dataclasses.replace(_field_type(inner), optional=True)
    if origin is Annotated:
        return dataclasses.replace(_field_type(arguments[0]), bounds=arguments[1])
    if origin is Literal:
        return FieldType(str, words=arguments)
    if origin is tuple:
        length = None if arguments[-1] is Ellipsis else len(arguments)
        return FieldType(tuple, items=_field_type(arguments[0]), length=length)
    return FieldType(hint)


def _read(node: Node, wanted: FieldType, path: str, *, settled: bool = False) -> FieldChoice:
    if wanted.base is tuple:
        return _read_list(node, wanted, path)
    if not isinstance(node.value, tuple):
        return _read_one(node, wanted, path)
    if settled:
        raise _wrong(node, path, f"{_described(wanted)}, one value and not several", node)
    if wanted.base in (int, float):
        return _read_range(node, wanted, path)
    if not node.value:
        raise _wrong(node, path, _described(wanted), node)
    return OneOf(
        tuple(_read_one(item, wanted, f"{path}[{k}]") for k, item in enumerate(node.value))
    )


def _read_list(node: Node, wanted: FieldType, path: str) -> FieldChoice:
    items = wanted.items
    if items is None or not isinstance(node.value, tuple):
        raise _wrong(node, path, _described(wanted), node)
    if wanted.length is not None and len(node.value) != wanted.length:
        raise _wrong(node, path, f"a list of {wanted.length}", node)
    return AllOf(tuple(_read_one(item, items, f"{path}[{k}]") for k, item in enumerate(node.value)))


def _read_range(node: Node, wanted: FieldType, path: str) -> FieldChoice:
    ends = node.value
    if not isinstance(ends, tuple) or len(ends) != 2:
        raise _wrong(node, path, f"{_described(wanted)}, or [low, high]", node)
    low, high = (_number(end, wanted, f"{path}[{k}]") for k, end in enumerate(ends))
    if low > high:
        raise ConfigError(
            f"{node.where}: {path}: expected [low, high], found [{low:g}, {high:g}]; exchange the two"
        )
    return Range(low, high, wanted.base is int)


def _read_one(node: Node, wanted: FieldType, path: str) -> FieldChoice:
    value = node.value
    if value is None and wanted.optional:
        return Fixed(None)
    if dataclasses.is_dataclass(wanted.base):
        return read_part(node, wanted.base, path)
    if wanted.base in (int, float):
        return Fixed(_number(node, wanted, path))
    value = spelled(value, wanted.words)
    fits = value in wanted.words if wanted.words else isinstance(value, wanted.base)
    if not fits:
        raise _wrong(
            node,
            path,
            _described(wanted),
            node,
            _remedy(wanted, value) + meant_text(value, wanted.words),
        )
    return Fixed(value)


def _number(node: Node, wanted: FieldType, path: str) -> float:
    value, bounds = node.value, wanted.bounds
    possible = (int,) if wanted.base is int else (int, float)
    if isinstance(value, bool) or not isinstance(value, possible) or not abs(value) < _MOST:
        raise _wrong(node, path, _described(wanted), node, _remedy(wanted, value))
    if bounds is not None and not bounds.low <= value <= bounds.high:
        raise _wrong(node, path, _described(wanted), node)
    return wanted.base(value)  # type: ignore[no-any-return]


def _wrong(node: Node, path: str, expected: str, found: Node, remedy: str = "") -> ConfigError:
    shown = _shown(found)
    clipped = shown if len(shown) <= _SHOWN_LENGTH else f"{shown[: _SHOWN_LENGTH - 1]}…"
    return ConfigError(f"{node.where}: {path}: expected {expected}, found {clipped}{remedy}")


def _remedy(wanted: FieldType, value: Scalar) -> str:
    """The remedy if only quotes are wrong or missing, or if YAML reads a number such as `1e1` as a text."""
    if (
        wanted.base is str
        and not wanted.words
        and not isinstance(value, Mapping | tuple)
        and value is not None
    ):
        return "; put it in quotes"
    if wanted.base in (int, float) and isinstance(value, str):
        return "; write a decimal number, without quotes and without e"
    return "; leave the quotes out" if wanted.base is bool and value in ("true", "false") else ""


def _described(wanted: FieldType) -> str:
    """A type in words."""
    if wanted.words:
        return f"one of {', '.join(wanted.words)}"
    if wanted.base is tuple and wanted.items is not None:
        return (
            f"a list, as [{', '.join(wanted.items.words[:2])}]" if wanted.items.words else "a list"
        )
    names = {str: "a text", bool: "true or false", int: "a whole number", float: "a number"}
    text = names.get(wanted.base, "keys and values")
    return f"{text}, {wanted.bounds}" if wanted.bounds else text


def _shown(node: Node) -> str:
    if isinstance(node.value, Mapping):
        return f"the keys {', '.join(node.value)}" if node.value else "nothing"
    if isinstance(node.value, tuple):
        return f"[{', '.join(_shown(item) for item in node.value)}]"
    if node.value is None:
        return "nothing"
    return repr(node.value) if isinstance(node.value, str) else str(node.value)
