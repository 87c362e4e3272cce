"""Pages and parts of them by the templates in `templates/`: whatever is not `Markup` is escaped, so no name adds tags.

Jinja2 is imported when the first page is made.
"""

from __future__ import annotations

import base64
import hashlib
import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

from deepaccident_devkit.errors import escaped
from deepaccident_devkit.support.text import counted, number_text
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import short_name

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

# A browser loads nothing and runs nothing, even if a name in the results tries to.
_POLICY: Final = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
_MOST_DIGITS: Final = 6
# Where a name may be broken.
_JOINTS: Final = re.compile(r"(?<=[/_=])(?=\w)|(?=@)")


@cache
def environment() -> Environment:
    """The templates; a name that is not there is an error."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(
        loader=PackageLoader("deepaccident_devkit.support"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    made.filters |= {
        "agent": short_name,
        "breakable": breakable,
        "counted": counted,
        "number": number_text,
        "path": path_in_address,
        "png": png_address,
        "result": result_text,
        "scalar": scalar,
        "thousands": "{:,}".format,
    }
    made.globals["version"] = __version__
    return made


def rendered(template: str, **context: Any) -> str:
    """A template of this name as text, with all that it shows; control characters are shown as in JSON."""
    return escaped(environment().get_template(template).render(**context))


def document(
    template: str, *, style: str, policy: str = _POLICY, script: str = "", **context: Any
) -> str:
    """A page that is one file, by a template that extends `document.html`, and the context that it shows.

    `policy` is the Content-Security-Policy: what a browser may load and run. `script` is the only one that runs, after
    the page is read; the policy then allows it too.
    """
    if script:
        policy += f"; script-src '{source_hash(script)}'"
    return rendered(template, style=style, policy=policy, script=script, **context)


def part(name: str) -> str:
    """A file beside the templates that is no template, such as a script."""
    return (files("deepaccident_devkit.support") / "templates" / name).read_text(encoding="utf-8")


def source_hash(text: str) -> str:
    """A source in a content security policy that allows only this text."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")


def breakable(text: str) -> Markup:
    """A text, escaped, whose names may be broken after `/`, `_` and `=` and before `@`; `Markup` as it is."""
    from markupsafe import Markup, escape

    return escape(text) if hasattr(text, "__html__") else Markup("<wbr>").join(_JOINTS.split(text))


def path_in_address(text: str) -> str:
    """A token as a part of an address."""
    return quote(text, safe="/")


def png_address(content: bytes) -> str:
    """A PNG picture as an address that holds it."""
    return f"data:image/png;base64,{base64.b64encode(content).decode('ascii')}"


def scalar(value: Any) -> str:
    """A value as text: numbers with few digits, a dash for an unknown value, `none` for no value at all."""
    if isinstance(value, list | tuple | Mapping) and not value:
        return "none"
    if isinstance(value, list | tuple):
        return _listed(value, scalar)
    if isinstance(value, Mapping):
        return ", ".join(f"{name}: {scalar(each)}" for name, each in value.items())
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.{_MOST_DIGITS}g}" if isinstance(value, float) else str(value)


def result_text(value: Any) -> str:
    """A result as text: three decimals, and three digits from 10 on; whole numbers whole; a dash for an unknown one."""
    if isinstance(value, list | tuple):
        return _listed(value, result_text)
    if isinstance(value, bool | str) or value is None or not math.isfinite(value):
        return scalar(value)
    if value == round(value):
        return f"{value:,.0f}"
    return (
        f"{value:.3f}"
        if abs(value) < 10
        else f"{value:.3g}"
        if abs(value) < 1000
        else f"{value:,.0f}"
    )


def _listed(values: Sequence[Any], text: Callable[[Any], str]) -> str:
    between = "; " if any(isinstance(each, list | tuple) for each in values) else ", "
    return between.join(map(text, values))
