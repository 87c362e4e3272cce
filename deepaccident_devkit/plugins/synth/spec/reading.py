"""The values of a scenario file with their lines, checked against the types of the model."""

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
from deepaccident_devkit.support.text import match_spelling, meant_text

if TYPE_CHECKING:
    import yaml

# The tags that PyYAML gives to plain values by itself.
_PLAIN_TAGS = tuple(
    f"tag:yaml.org,2002:{name}"
    for name in ("map", "seq", "str", "int", "float", "bool", "null", "timestamp")
)
# Numbers that people and YAML read in the same way. YAML 1.1 also reads 010 as eight, 1:30 as
# ninety and 1_0 as ten, which few people expect.
_DECIMAL_PATTERN = re.compile(
    r"[-+]?(\.inf|\.nan|(0|[1-9]\d*)(\.\d*)?([eE][-+]?\d+)?|\.\d+)", re.IGNORECASE
)
# Fields that must have one value, no range or list of choices, because they decide which other
# fields are needed.
_SINGLE_VALUE_FIELDS = {"name", "design", "exchange", "role"}
# A number that is larger than any number in a scenario.
_NUMBER_LIMIT = 1e9
# Largest number of characters of a value that a message shows.
_MAX_VALUE_CHARACTERS = 80
# A plain word of YAML: a string, a number, a boolean or None, or something that fits no field.
Scalar: TypeAlias = object


@dataclass(frozen=True, slots=True)
class Node:
    """A value and its line.

    Attributes:
        where: Line, such as `mine.yaml:12`; for the value of a key, the line of the key.
        value: A scalar, the entries of a mapping, or the items of a list.
    """

    where: str
    value: Scalar | Mapping[str, Node] | tuple[Node, ...]


def parse_yaml(text: str, source: str) -> Node:
    """Parse the tree of a YAML text: one document, without tags, anchors or aliases.

    Args:
        text: The YAML text.
        source: Name of the text in messages.

    Raises:
        ConfigError: The text is empty or not YAML, or contains a repeated key, a key that is not a
            word, an alias, a tag, or a number that is not decimal; the message gives line, path and
            remedy.
    """
    import yaml

    try:
        loader = yaml.SafeLoader(text)
        root = loader.get_single_node()
        if root is None:
            raise ConfigError(
                f"{source}: is empty; write at least the actors ego and other (docs/synth.md)"
            )
        return _TreeReader(source, loader).node(root, root.start_mark.line)
    except yaml.MarkedYAMLError as error:
        raise ConfigError(f"{source}:{_describe_fault(error)}") from error
    except (yaml.YAMLError, RecursionError) as error:
        fault = shortened(str(error).splitlines()[0])
        raise ConfigError(
            f"{source}: is not valid YAML: {fault}; save it again as plain text"
        ) from error


def _describe_fault(error: yaml.MarkedYAMLError) -> str:
    """Return the message of an error, from the number of the line on.

    PyYAML often finds a fault only some lines after the real one.
    """
    lines: list[int] = []
    for mark in (error.problem_mark, error.context_mark):
        if mark and mark.line + 1 not in lines:
            lines.append(mark.line + 1)
    first_line = lines[0] if lines else 1
    beginning = ""
    if len(lines) > 1:
        beginning = f", or line {lines[1]}, where the faulty part begins"
    problem = shortened(str(error.problem))
    return (
        f"{first_line}: is not valid YAML: {problem}; check the quotes, brackets and indentation "
        f"(no tabs) of that line{beginning}"
    )


class _TreeReader:
    """A reader that converts PyYAML's nodes to `Node`s.

    A node that is read a second time is an alias.
    """

    def __init__(self, source: str, loader: yaml.SafeLoader) -> None:
        self._source = source
        self._loader = loader
        self._node_ids: set[int] = set()

    def node(self, raw: yaml.Node, line: int, path: str = "") -> Node:
        """Convert a node with everything in it; `path` is its path, such as `actors[1]`."""
        import yaml

        where = f"{self._source}:{line + 1}"
        if id(raw) in self._node_ids:
            raise self._make_error(
                line, path, "aliases (*name) are not supported; write the value out"
            )
        self._node_ids.add(id(raw))
        if not raw.tag.startswith(_PLAIN_TAGS):
            sentence = f"tags ({shortened(raw.tag)}) are not supported; remove the tag"
            raise self._make_error(line, path, sentence)
        if isinstance(raw, yaml.MappingNode):
            return Node(where, self._read_entries(raw, path))
        if isinstance(raw, yaml.SequenceNode):
            items = [
                self.node(item, item.start_mark.line, f"{path}[{index}]")
                for index, item in enumerate(raw.value)
            ]
            return Node(where, tuple(items))
        return Node(where, self._read_scalar(raw, line, path))

    def _read_scalar(self, raw: yaml.Node, line: int, path: str) -> Scalar:
        """Return a scalar's value; raise ConfigError for a tag or a number that is not decimal."""
        try:
            value = self._loader.construct_object(raw)
        except (ValueError, LookupError, AttributeError, OverflowError) as error:
            # PyYAML raises them if a tag does not fit.
            fault = shortened(str(error))
            sentence = (
                f"{raw.value[:40]!r} cannot be read ({fault}); put it in quotes if it is a word"
            )
            raise self._make_error(line, path, sentence) from error
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if is_number and not _DECIMAL_PATTERN.fullmatch(raw.value):
            sentence = (
                f"{shortened(raw.value)!r} is not a plain decimal number; "
                "write one, or put it in quotes if it is a word"
            )
            raise self._make_error(line, path, sentence)
        return value

    def _read_entries(self, raw: yaml.MappingNode, path: str) -> dict[str, Node]:
        """Return a mapping's entries by key; raise ConfigError for a repeated or unusual key."""
        entries: dict[str, Node] = {}
        for raw_key, raw_value in raw.value:
            key = raw_key.value
            line = raw_key.start_mark.line
            if not isinstance(key, str):
                sentence = "expected a word as a key, found a list or mapping; write a word"
                raise self._make_error(line, path, sentence)
            entry_path = f"{path}.{key}" if path else key
            if key in entries:
                raise self._make_error(line, entry_path, "appears twice; keep one of them")
            entries[key] = self.node(raw_value, line, entry_path)
        return entries

    def _make_error(self, line: int, path: str, sentence: str) -> ConfigError:
        """Return the error for a line and a path."""
        location = f"{self._source}:{line + 1}"
        if path:
            location = f"{location}: {shortened(path)}"
        return ConfigError(f"{location}: {sentence}")


@dataclass(frozen=True, slots=True)
class FieldType:
    """The possible values of a field of the model.

    Attributes:
        base: `str`, `bool`, `int`, `float`, a dataclass, or `tuple` for a list.
        optional: Whether the value can be null.
        words: Possible words; empty for a free text.
        bounds: Bounds of a number.
        items: Type of the items of a list.
        length: Length of a list; None if any length is possible.
    """

    base: type[Any]
    optional: bool = False
    words: tuple[str, ...] = ()
    bounds: Bounds | None = None
    items: FieldType | None = None
    length: int | None = None


def field_types(kind: type[Any]) -> dict[str, FieldType]:
    """Return the types of a model dataclass's fields, by name."""
    hints = get_type_hints(kind, include_extras=True)
    names = [field.name for field in dataclasses.fields(kind)]
    return {name: _parse_type_hint(hints[name]) for name in names}


def required_fields(kind: type[Any]) -> tuple[str, ...]:
    """Return the names of a dataclass's fields that have no default."""
    missing = dataclasses.MISSING
    names = []
    for field in dataclasses.fields(kind):
        if field.default is missing and field.default_factory is missing:
            names.append(field.name)
    return tuple(names)


def read_part(node: Node, kind: type[Any], path: str = "") -> Part:
    """Read a part of a scenario from a mapping.

    Args:
        node: The mapping.
        kind: Dataclass of the part.
        path: Path of the part in the file, such as `actors[1]`; empty for the whole file.

    Raises:
        ConfigError: The node is not a mapping, has an unknown key, lacks a required one, or a value
            does not fit its field.
    """
    entries = node.value
    if not isinstance(entries, Mapping):
        raise _make_mismatch(node, path or "the file", "keys and values")
    types_by_name = field_types(kind)
    names_by_key = {key_of(name): name for name in types_by_name}
    prefix = f"{path}." if path else ""
    for key, entry in entries.items():
        if key not in names_by_key:
            possible = f"possible: {', '.join(names_by_key)}{meant_text(key, names_by_key)}"
            raise ConfigError(f"{entry.where}: {prefix}{shortened(key)}: no such field; {possible}")
    for name in required_fields(kind):
        if key_of(name) not in entries:
            raise ConfigError(f"{node.where}: {prefix}{key_of(name)}: is missing; add it")
    fields = {}
    lines = {}
    for key, name in names_by_key.items():
        if key in entries:
            single = name in _SINGLE_VALUE_FIELDS
            fields[name] = _read(entries[key], types_by_name[name], prefix + key, single=single)
            lines[name] = entries[key].where
    return Part(kind, node.where, path, fields, lines)


def _parse_type_hint(hint: Any) -> FieldType:
    """Return the field type that a type hint describes."""
    origin = get_origin(hint)
    arguments = get_args(hint)
    if origin in (Union, types.UnionType):
        (member,) = (argument for argument in arguments if argument is not type(None))
        return dataclasses.replace(_parse_type_hint(member), optional=True)
    if origin is Annotated:
        return dataclasses.replace(_parse_type_hint(arguments[0]), bounds=arguments[1])
    if origin is Literal:
        return FieldType(str, words=arguments)
    if origin is tuple:
        length = None
        if arguments[-1] is not Ellipsis:
            length = len(arguments)
        return FieldType(tuple, items=_parse_type_hint(arguments[0]), length=length)
    return FieldType(hint)


def _read(node: Node, field_type: FieldType, path: str, *, single: bool) -> FieldChoice:
    """Read a field with its open choices; raise ConfigError if the value does not fit.

    Args:
        node: Value of the field.
        field_type: Type of the field.
        path: Path of the field, for messages.
        single: Whether the field must have one value, no range or list of choices.
    """
    if field_type.base is tuple:
        return _read_list(node, field_type, path)
    if not isinstance(node.value, tuple):
        return _read_value(node, field_type, path)
    if single:
        raise _make_mismatch(node, path, f"{_describe_type(field_type)}, one value, not several")
    if field_type.base in (int, float):
        return _read_range(node, field_type, path)
    if not node.value:
        raise _make_mismatch(node, path, _describe_type(field_type))
    return OneOf(_read_items(node.value, field_type, path))


def _read_list(node: Node, field_type: FieldType, path: str) -> FieldChoice:
    """Read a list with all its items; raise ConfigError if one does not fit."""
    nodes = node.value
    item_type = field_type.items
    if item_type is None or not isinstance(nodes, tuple):
        raise _make_mismatch(node, path, _describe_type(field_type))
    if field_type.length not in (None, len(nodes)):
        raise _make_mismatch(node, path, f"a list of {field_type.length}")
    return AllOf(_read_items(nodes, item_type, path))


def _read_items(
    nodes: tuple[Node, ...], item_type: FieldType, path: str
) -> tuple[FieldChoice, ...]:
    """Read the items of a list; raise ConfigError if one does not fit."""
    items = []
    for index, node in enumerate(nodes):
        item_path = f"{path}[{index}]"
        items.append(_read_value(node, item_type, item_path))
    return tuple(items)


def _read_range(node: Node, field_type: FieldType, path: str) -> FieldChoice:
    """Read a range of numbers; raise ConfigError if it is not valid."""
    bounds = node.value
    if not isinstance(bounds, tuple) or len(bounds) != 2:
        raise _make_mismatch(node, path, f"{_describe_type(field_type)}, or [low, high]")
    low = _read_number(bounds[0], field_type, f"{path}[0]")
    high = _read_number(bounds[1], field_type, f"{path}[1]")
    if low > high:
        raise ConfigError(
            f"{node.where}: {path}: expected [low, high], found [{low:g}, {high:g}]; swap the two"
        )
    return Range(low, high, field_type.base is int)


def _read_value(node: Node, field_type: FieldType, path: str) -> FieldChoice:
    """Read one value; raise ConfigError if it does not fit its field."""
    value = node.value
    if value is None and field_type.optional:
        return Fixed(None)
    if dataclasses.is_dataclass(field_type.base):
        return read_part(node, field_type.base, path)
    if field_type.base in (int, float):
        return Fixed(_read_number(node, field_type, path))
    words = field_type.words
    value = match_spelling(value, words)
    fits = isinstance(value, field_type.base)
    if words:
        fits = value in words
    if not fits:
        remedy = _find_remedy(field_type, value) + meant_text(value, words)
        raise _make_mismatch(node, path, _describe_type(field_type), remedy)
    return Fixed(value)


def _read_number(node: Node, field_type: FieldType, path: str) -> float:
    """Read a number; raise ConfigError unless it lies within its bounds."""
    value = node.value
    bounds = field_type.bounds
    number_types = (int,) if field_type.base is int else (int, float)
    if (
        isinstance(value, bool)
        or not isinstance(value, number_types)
        or not abs(value) < _NUMBER_LIMIT
    ):
        remedy = _find_remedy(field_type, value)
        raise _make_mismatch(node, path, _describe_type(field_type), remedy)
    if bounds is not None and not bounds.low <= value <= bounds.high:
        raise _make_mismatch(node, path, _describe_type(field_type))
    return field_type.base(value)  # type: ignore[no-any-return]


def _make_mismatch(node: Node, path: str, expected: str, remedy: str = "") -> ConfigError:
    """Return the error for a value that does not fit its field."""
    value = _format_value(node)
    if len(value) > _MAX_VALUE_CHARACTERS:
        value = f"{value[: _MAX_VALUE_CHARACTERS - 1]}…"
    return ConfigError(f"{node.where}: {path}: expected {expected}, found {value}{remedy}")


def _find_remedy(field_type: FieldType, value: Scalar) -> str:
    """Return the remedy for wrong or missing quotes, or for a number that YAML reads as a text.

    YAML reads a number such as `1e1` as a text. The remedy is empty for other faults.
    """
    free_text = field_type.base is str and not field_type.words
    if free_text and not isinstance(value, Mapping | tuple) and value is not None:
        return "; put it in quotes"
    if field_type.base in (int, float) and isinstance(value, str):
        return "; write a decimal number, without quotes and without e"
    if field_type.base is bool and value in ("true", "false"):
        return "; remove the quotes"
    return ""


def _describe_type(field_type: FieldType) -> str:
    """Return a type in words."""
    if field_type.words:
        return f"one of {', '.join(field_type.words)}"
    if field_type.base is tuple and field_type.items is not None:
        examples = field_type.items.words[:2]
        if examples:
            return f"a list, as [{', '.join(examples)}]"
        return "a list"
    names = {str: "a text", bool: "true or false", int: "a whole number", float: "a number"}
    text = names.get(field_type.base, "keys and values")
    if field_type.bounds is None:
        return text
    return f"{text}, {field_type.bounds}"


def _format_value(node: Node) -> str:
    """Return a value as messages show it."""
    value = node.value
    if isinstance(value, Mapping) and value:
        return f"the keys {', '.join(value)}"
    if isinstance(value, tuple):
        items = [_format_value(item) for item in value]
        return f"[{', '.join(items)}]"
    if value is None or isinstance(value, Mapping):
        return "nothing"
    if isinstance(value, str):
        return repr(value)
    return str(value)
