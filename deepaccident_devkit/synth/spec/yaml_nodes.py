"""A YAML text as a tree in which each value has its line."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeAlias

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.reading import shortened

if TYPE_CHECKING:
    import yaml

_PLAIN_TAGS: Final = tuple(
    f"tag:yaml.org,2002:{name}" for name in ("map", "seq", "str", "int", "float", "bool", "null", "timestamp")
)
"""The tags that PyYAML gives to plain values by itself."""
_DECIMAL: Final = re.compile(r"[-+]?(\.inf|\.nan|(0|[1-9]\d*)(\.\d*)?([eE][-+]?\d+)?|\.\d+)", re.IGNORECASE)
"""YAML 1.1 also reads 010 as eight, 1:30 as ninety and 1_0 as ten, which few expect."""
Scalar: TypeAlias = object
"""The type of a plain word of YAML: a string, a number, a boolean, None; or something that fits no field."""


@dataclass(frozen=True, slots=True)
class Node:
    """A value and its line.

    Attributes:
        where: such as `mine.yaml:12`; for the value of a key, the line of the key.
        value: a scalar, the entries of a mapping, or the items of a list.
        quoted: whether it is a scalar in quotes.
    """

    where: str
    value: Scalar | Mapping[str, Node] | tuple[Node, ...]
    quoted: bool = False


def parse_yaml(text: str, source: str) -> Node:
    """The tree of a YAML text.

    Args:
        text: one document, without tags, anchors or aliases.
        source: its name in messages, such as the file's path.

    Raises:
        ConfigError: it is empty or no YAML, or has a repeated key, a key that is no word, an alias, a tag, or a number
            that is not decimal; line, path and remedy are in the message.
    """
    import yaml

    try:
        loader = yaml.SafeLoader(text)
        root = loader.get_single_node()
        if root is None:
            raise ConfigError(f"{source}: is empty; write at least the actors ego and other (docs/scenarios.md)")
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
            raise self._error(line, path, f"tags ({shortened(raw.tag)}) are not read here; leave the tag out")
        if isinstance(raw, yaml.MappingNode):
            return Node(where, self._entries(raw, path))
        if isinstance(raw, yaml.SequenceNode):
            items = enumerate(raw.value)
            return Node(where, tuple(self.node(item, item.start_mark.line, f"{path}[{k}]") for k, item in items))
        quoted = isinstance(raw, yaml.ScalarNode) and raw.style in ("'", '"')
        return Node(where, self._scalar(raw, line, path), quoted)

    def _scalar(self, raw: yaml.Node, line: int, path: str) -> Scalar:
        try:
            value = self._loader.construct_object(raw)
        except (ValueError, LookupError, AttributeError, OverflowError) as error:  # of PyYAML, if a tag does not fit
            told = shortened(str(error))
            sentence = f"{raw.value[:40]!r} cannot be read ({told}); put it in quotes if it is a word"
            raise self._error(line, path, sentence) from error
        if isinstance(value, int | float) and not isinstance(value, bool) and not _DECIMAL.fullmatch(raw.value):
            found = f"{shortened(raw.value)!r} is not a plain decimal number"
            raise self._error(line, path, f"{found}; write one, or put it in quotes if it is a word")
        return value

    def _entries(self, raw: yaml.MappingNode, path: str) -> dict[str, Node]:
        entries: dict[str, Node] = {}
        for raw_key, raw_value in raw.value:
            key, line = raw_key.value, raw_key.start_mark.line
            if not isinstance(key, str):
                raise self._error(line, path, "expected a key that is a word, found a list or mapping; write a word")
            inner = f"{path}.{key}" if path else key
            if key in entries:
                raise self._error(line, inner, "is there twice; keep one of them")
            entries[key] = self.node(raw_value, line, inner)
        return entries

    def _error(self, line: int, path: str, sentence: str) -> ConfigError:
        parts = (f"{self._source}:{line + 1}", shortened(path), sentence)
        return ConfigError(": ".join(part for part in parts if part))
