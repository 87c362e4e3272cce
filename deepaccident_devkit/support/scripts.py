"""JavaScript modules bundled into one script, for single-file pages and pages without a server.

Browsers load no modules from a disk, and the policy of a single page only allows one script.
"""

import re
from collections.abc import Callable

_IMPORT = re.compile(r'^import \{(\s*\w+(?:,\s*\w+)*,?\s*)\} from "\./(\w+)\.js";$', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async function|function|class|const) (\w+))", re.MULTILINE)
# A comment with types, which browsers do not need.
_TYPES = re.compile(r"^ */\*\*(?:(?!\*/).)*\*/\n", re.MULTILINE | re.DOTALL)
_UNKNOWN = re.compile(r"^(?:import|export)\b.*", re.MULTILINE)


def bundled(read: Callable[[str], str], name: str) -> str:
    """Return a module and all its imports as one script, without global names and type comments.

    Args:
        read: Function that returns the text of a module in the same folder, such as `clock.js`.
        name: Name of the module without its suffix.

    Raises:
        ValueError: If modules import each other, or if one has an import or export of another form
            than `import { a, b } from "./name.js";` and `export` before a function, a class or a
            constant.
        OSError: If `read` does not find a module.
    """
    modules: dict[str, str] = {}
    _add_module(read, name, (), modules)
    return f'(() => {{\n"use strict";\n{"".join(modules.values())}}})();\n'


def _add_module(
    read: Callable[[str], str], name: str, importers: tuple[str, ...], modules: dict[str, str]
) -> None:
    """Add a module to `modules`, after its imports."""
    if name in importers:
        raise ValueError(f"modules import each other: {' imports '.join((*importers, name))}")
    if name in modules:
        return
    text = _TYPES.sub("", read(f"{name}.js"))
    for imported in _IMPORT.finditer(text):
        _add_module(read, imported[2], (*importers, name), modules)
    exports = ", ".join(_EXPORT.findall(text))
    body = _EXPORT.sub("", _IMPORT.sub(r"const {\1} = module_\2;", text))
    unknown = _UNKNOWN.search(body)
    if unknown:
        raise ValueError(f"{name}.js: the bundler does not know this form: {unknown[0]}")
    modules[name] = f"const module_{name} = (() => {{\n{body}return {{ {exports} }};\n}})();\n"
