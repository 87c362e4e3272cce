"""Versions of the devkit, Python and the libraries: what a report of a bug needs."""

import platform
import re
from importlib.metadata import PackageNotFoundError, requires, version
from typing import Final

from deepaccident_devkit._version import __version__
from deepaccident_devkit.text import columns_text

_PACKAGE: Final = "deepaccident_devkit"
_NAME: Final = re.compile(r"[\w.-]+")
_DEVELOPERS: Final = re.compile(r"extra == .(test|lint|docs)\b")
"""Requirements for work on the devkit itself."""


def version_text(*, every: bool) -> str:
    """The devkit's version; with `every` a table that has Python, the system and each library of any extra."""
    if not every:
        return f"deepaccident, version {__version__}"
    rows = [("deepaccident", __version__), ("Python", platform.python_version()), ("system", platform.platform())]
    return columns_text([*rows, *((name, _installed(name)) for name in _libraries())])


def _libraries() -> list[str]:
    """The names in the package's requirements and in the users' extras, in alphabetical order."""
    users = [each for each in requires(_PACKAGE) or () if not _DEVELOPERS.search(each)]
    return sorted({match.group().lower() for each in users if (match := _NAME.match(each))})


def _installed(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"
