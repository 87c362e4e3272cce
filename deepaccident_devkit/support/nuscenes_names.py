"""Names of the nuScenes devkit that this devkit lacks, and their counterparts here.

docs/nuscenes_names.md lists them.
"""

import json
from collections.abc import Callable, Mapping
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Final, NoReturn, ParamSpec, TypeVar

from deepaccident_devkit.errors import KeywordError, MissingNameError
from deepaccident_devkit.support.text import meant_text

_T = TypeVar("_T")
P = ParamSpec("P")
_PAGE = "docs/nuscenes_names.md"
_HINTS = json.loads(Path(__file__).with_suffix(".json").read_bytes())


def _collect_hints(kind: str) -> Mapping[str, str]:
    hints: dict[str, str] = {}
    for hint, names in _HINTS[kind].items():
        hints |= dict.fromkeys(names, hint)
    return hints


# nuScenes' tables → what to use here.
TABLES: Final = _collect_hints("tables")
# Attributes of nuScenes' `NuScenes` and `NuScenesExplorer` → what to use here.
DATASET: Final = _collect_hints("dataset")
# Attributes of nuScenes' `Box` → what to use here.
BOX: Final = _collect_hints("box")
# Attributes of nuScenes' `LidarPointCloud` → what to use here.
CLOUD: Final = _collect_hints("cloud")
# Arguments of nuScenes' methods → what to use here.
KEYWORDS: Final = _collect_hints("keywords")
# Fields of nuScenes' records → what to use here.
FIELD_HINTS: Final = _collect_hints("fields")
# What to use here instead of constructing nuScenes' `Box`.
BOX_MADE: Final = (
    "boxes[0] picks one, and nuScenes' Box(center, wlh, orientation) is Box.from_wlh(center, wlh, "
    f"orientation, frame='ego') (see {_PAGE})"
)


class AbsentName:
    """An attribute that only nuScenes' class has: reading it in ours raises MissingNameError.

    `hasattr` is therefore False. A `__getattr__` of the class would do the same, but would slow
    down all other attributes.
    """

    def __init__(self, name: str, counterpart: str) -> None:
        """Store the name, and what to use here."""
        self._name = name
        self._counterpart = counterpart

    def __get__(self, instance: object, owner: type) -> NoReturn:
        raise missing_name(owner, self._name, self._counterpart)


def without_names(counterparts: Mapping[str, str]) -> Callable[[type[_T]], type[_T]]:
    """Return a class decorator: reading one of these names raises an error with its counterpart."""

    def add_absent_names(owner: type[_T]) -> type[_T]:
        for name, counterpart in counterparts.items():
            setattr(owner, name, AbsentName(name, counterpart))
        return owner

    return add_absent_names


def missing_name(owner: type, name: str, counterpart: str) -> MissingNameError:
    """Return the error for a name that a class lacks."""
    message = f"{owner.__name__} has no {name!r}: {counterpart} (see {_PAGE})"
    return MissingNameError(message)


def with_keywords_named(function: Callable[P, _T], module: str | None = None) -> Callable[P, _T]:
    """Return a function that raises KeywordError for unknown arguments, and calls `function`.

    For an argument of nuScenes' functions the error names the counterpart here, and for any other
    argument a similar one. `module` is where pickle finds the result; None for the module of the
    function itself.
    """
    parameters = signature(function).parameters
    takes_any = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())
    function_name = function.__qualname__.removesuffix(".__init__").rpartition(".")[2]

    @wraps(function)
    def checked(*arguments: P.args, **keywords: P.kwargs) -> _T:
        unknown_names = keywords.keys() - parameters.keys() if keywords else ()
        for name in sorted(unknown_names):
            if name in KEYWORDS:
                raise KeywordError(
                    f"{function_name} has no argument {name!r}: {KEYWORDS[name]} (see {_PAGE})"
                )
            if not takes_any:
                raise KeywordError(
                    f"{function_name} has no argument {name!r}{meant_text(name, parameters)}"
                )
        return function(*arguments, **keywords)

    checked.__module__ = module or function.__module__
    return checked


def table_remedy(name: object) -> str:
    """Return the end of a message about a table of nuScenes; empty for any other name."""
    counterpart = TABLES.get(name) if isinstance(name, str) else None
    if counterpart:
        return f"; for nuScenes' table {name!r}: {counterpart} (see {_PAGE})"
    return ""


def field_remedy(name: object) -> str:
    """Return the end of a message about a field of nuScenes' records; empty for any other name."""
    counterpart = FIELD_HINTS.get(name) if isinstance(name, str) else None
    if counterpart:
        return f": {counterpart} (see {_PAGE})"
    return ""
