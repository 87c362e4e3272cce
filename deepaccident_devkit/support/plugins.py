"""Plug-ins: products on top of the core that add subcommands, formats, tasks and more.

See docs/plugins.md. The devkit's own plug-ins are the folders of `deepaccident_devkit/plugins` with
a `plugin.py`. Others are installed packages with an entry point in the group
`deepaccident_devkit.plugins`. Each provides one object, a `Plugin`, whose offers are imported when
they are first used.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, TypeVar

from deepaccident_devkit.errors import MissingPluginError

if TYPE_CHECKING:
    import click

    from deepaccident_devkit.deepaccident import DeepAccident
    from deepaccident_devkit.evaluation.evaluator import Evaluator
    from deepaccident_devkit.evaluation.runs.further import ExtraResult
    from deepaccident_devkit.export.format import Format

PROTOCOL_VERSION: Final = 1
"""Version of `Plugin`; a plug-in written for another version is left out."""
ENTRY_POINT_GROUP: Final = "deepaccident_devkit.plugins"
# Environment variable; `off` disables plug-ins that are not the devkit's own.
OFF_SWITCH: Final = "DEEPACCIDENT_PLUGINS"
_FOLDER = Path(__file__).parents[1] / "plugins"
_PACKAGE = f"{__package__.partition('.')[0]}.plugins"


class LazyVerb(NamedTuple):
    """A subcommand: a line for the list of subcommands, and a function that imports it."""

    summary: str
    load: Callable[[], click.Command]


class LazyFormat(NamedTuple):
    """A format of `deepaccident export`: a line for the list, and a function that imports it."""

    summary: str
    load: Callable[[], type[Format]]


class LazyTask(NamedTuple):
    """A task of `deepaccident evaluate`: a line for the list, and a function that imports it."""

    summary: str
    load: Callable[[], type[Evaluator[Any]]]


class Opener(NamedTuple):
    """A function that opens dataroots of another dataset, and one that recognizes them.

    Attributes:
        recognizes: Folder → whether it is such a dataroot.
        open_release: Folder, folder for the index or None → the release.
    """

    recognizes: Callable[[Path], bool]
    open_release: Callable[[Path, Path | None], DeepAccident]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Plugin:
    """The offers of a plug-in, by name; each is imported when it is used.

    Attributes:
        name: Name that messages use.
        protocol_version: `PROTOCOL_VERSION` of the devkit that the plug-in was written for.
        verbs: Verbs of the command line; `check NAME` is a verb of the group `check`.
        openers: Openers of other datasets, by the dataset's name.
        export_formats: Formats of `deepaccident export`.
        tasks: Tasks of `deepaccident evaluate`.
        extra_results: Functions that import extra results of evaluations.
    """

    name: str
    protocol_version: int
    verbs: Mapping[str, LazyVerb] = field(default_factory=dict)
    openers: Mapping[str, Opener] = field(default_factory=dict)
    export_formats: Mapping[str, LazyFormat] = field(default_factory=dict)
    tasks: Mapping[str, LazyTask] = field(default_factory=dict)
    extra_results: Mapping[str, Callable[[], ExtraResult]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise TypeError if an offer has the wrong type."""
        kinds = {
            "verbs": LazyVerb,
            "openers": Opener,
            "export_formats": LazyFormat,
            "tasks": LazyTask,
        }
        for name, kind in kinds.items():
            for value in getattr(self, name).values():
                if not isinstance(value, kind):
                    raise TypeError(
                        f"{name}: expected objects of the class {kind.__name__}, found {value!r}"
                    )

    def __repr__(self) -> str:
        """Return its kind and name."""
        return f"Plugin({str(self.name)[:50]!r})"


Offered = TypeVar("Offered")


@dataclass(frozen=True, slots=True)
class Offers(Generic[Offered]):
    """The offers of one kind that all plug-ins make.

    Attributes:
        by_name: Name → offer.
        refused: Plug-in → reason why it, or one of its names, is left out.
    """

    by_name: Mapping[str, Offered]
    refused: Mapping[str, str]

    def refusals_text(self) -> str:
        """Return a line for each plug-in that is left out; empty if there is none."""
        return "\n".join(
            f"Plug-in {name} was ignored: {reason}." for name, reason in self.refused.items()
        )


def offers(
    read: Callable[[Plugin], Mapping[str, Offered]],
    core: Collection[str] = (),
    *,
    own: bool = False,
) -> Offers[Offered]:
    """Collect the offers of one kind that all plug-ins make.

    Args:
        read: Function that returns the offers of a plug-in.
        core: Names that the core uses, which plug-ins cannot offer.
        own: Whether to use only the devkit's own plug-ins, without reading entry points.

    Returns:
        Offers by name. If several plug-ins offer the same name, the devkit's own plug-in gets it;
            if none of them is the devkit's own, the name is left out.
    """
    installed = own_plugins() if own else all_plugins()
    refused = dict(installed.refused)
    owners_by_name: dict[str, list[tuple[str, Offered]]] = {}
    for plugin in installed.plugins:
        for name, offer in read(plugin).items():
            owners_by_name.setdefault(name, []).append((plugin.name, offer))
    by_name = {}
    own_names = {plugin.name for plugin in own_plugins().plugins}
    for name, owners in owners_by_name.items():
        first_plugin, first_offer = owners[0]
        plugin_names = [plugin_name for plugin_name, _ in owners]
        if name in core:
            reason = f"it offers {name!r}, which is part of the devkit"
            refused |= dict.fromkeys(plugin_names, reason)
        elif len(owners) == 1:
            by_name[name] = first_offer
        elif first_plugin in own_names:  # the own plug-ins come first
            by_name[name] = first_offer
            reason = f"it offers {name!r}, which {first_plugin} also offers"
            refused |= dict.fromkeys(plugin_names[1:], reason)
        else:
            reason = f"{' and '.join(plugin_names)} both offer {name!r}; uninstall one of them"
            refused |= dict.fromkeys(plugin_names, reason)
    return Offers(by_name, refused)


class Installed(NamedTuple):
    """The loaded plug-ins, and the reason for each that was not loaded."""

    plugins: tuple[Plugin, ...]
    refused: Mapping[str, str]


@cache
def own_plugins() -> Installed:
    """Load the devkit's own plug-ins, without the packages that they describe."""
    paths = sorted(_FOLDER.glob("*/plugin.py"))
    return _load_plugins((path.parent.name, partial(_load_plugin_file, path)) for path in paths)


@cache
def all_plugins() -> Installed:
    """Load the devkit's own plug-ins and, unless they are switched off, other installed ones."""
    from importlib.metadata import entry_points  # reading them takes milliseconds

    own = own_plugins()
    if os.environ.get(OFF_SWITCH, "").lower() == "off":
        return own
    points = sorted(entry_points(group=ENTRY_POINT_GROUP), key=lambda point: point.name)
    external = _load_plugins((point.name, point.load) for point in points)
    return Installed((*own.plugins, *external.plugins), {**own.refused, **external.refused})


def need_plugin(name: str, purpose: str) -> None:
    """Raise MissingPluginError, with `purpose` in it, if a plug-in of the devkit is missing."""
    if not (_FOLDER / name / "plugin.py").is_file():
        raise MissingPluginError(
            f"{purpose}: needs the plug-in {name}, which is not installed; install the whole devkit"
        )


def _load_plugins(loaders: Iterable[tuple[str, Callable[[], Any]]]) -> Installed:
    """Load plug-ins with their loaders, and record why others cannot be loaded."""
    plugins = []
    refused: dict[str, str] = {}
    for name, load_plugin in loaders:
        try:
            plugin = load_plugin()
        except Exception as error:  # noqa: BLE001 - whatever somebody else's code raises
            refused[name] = f"{type(error).__name__}: {error}"
            continue
        if not isinstance(plugin, Plugin):
            refused[name] = f"expected an object of the class Plugin, found {type(plugin).__name__}"
        elif plugin.protocol_version != PROTOCOL_VERSION:
            version = plugin.protocol_version
            refused[name] = (
                f"it is for version {version} of the plug-in protocol, but this devkit has "
                f"{PROTOCOL_VERSION}"
            )
        else:
            plugins.append(plugin)
    return Installed(tuple(plugins), refused)


def _load_plugin_file(path: Path) -> Any:
    """Load the object of a `plugin.py` without its package, which may be slow to import."""
    spec = importlib.util.spec_from_file_location(f"{_PACKAGE}.{path.parent.name}.plugin", path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path}: cannot be imported")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.PLUGIN
