"""Pages and parts of them from the templates in `templates/`.

All texts except `Markup` are escaped, so no name adds tags. Jinja2 is imported for the first page.
"""

from __future__ import annotations

import base64
import hashlib
import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from importlib.resources import files
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from deepaccident_devkit.errors import escaped
from deepaccident_devkit.support.human_names import human_name, metric_name
from deepaccident_devkit.support.text import counted, number_text, with_minus
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import short_name

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

# A browser loads nothing and runs nothing, even if a name in the results tries to.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
_MAX_DIGITS = 6
# Positions where a name may be broken.
_BREAK_POINTS = re.compile(r"(?<=[/_=])(?=\w)|(?=@)")


@cache
def environment() -> Environment:
    """Return the templates' Jinja environment, in which an undefined name is an error."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    templates = Environment(
        loader=PackageLoader("deepaccident_devkit.support"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    templates.filters |= {
        "agent": short_name,
        "attribute": partial(human_name, kind="attributes"),
        "breakable": breakable,
        "counted": counted,
        "human": human_name,
        "metric": metric_name,
        "minus": with_minus,
        "number": number_text,
        "path": path_in_address,
        "png": png_address,
        "result": result_text,
        "scalar": scalar,
        "task": partial(human_name, kind="tasks"),
        "thousands": "{:,}".format,
    }
    templates.globals["version"] = __version__
    return templates


def rendered(template: str, **context: Any) -> str:
    """Return a filled template as text; control characters are shown as in JSON."""
    return escaped(environment().get_template(template).render(**context))


def document(
    template: str, *, style: str, policy: str = _POLICY, script: str = "", **context: Any
) -> str:
    """Return a page that is one file, from a template that extends `document.html`.

    Args:
        template: Name of the template.
        style: Style sheet.
        policy: Content-Security-Policy: what a browser may load and run.
        script: The only script that runs, after the page is read; the policy then allows it too.
        **context: Further variables of the template.
    """
    if script:
        policy += f"; script-src '{source_hash(script)}'"
    return rendered(template, style=style, policy=policy, script=script, **context)


def part(name: str) -> str:
    """Read a file that lies next to the templates, such as a script."""
    path = files("deepaccident_devkit.support") / "templates" / name
    return path.read_text(encoding="utf-8")


def source_hash(text: str) -> str:
    """Return the source of a content security policy that allows only this text."""
    digest = hashlib.sha256(text.encode()).digest()
    return f"sha256-{base64.b64encode(digest).decode('ascii')}"


def breakable(text: str) -> Markup:
    """Return escaped text in which a line may break after `/`, `_` and `=` and before `@`.

    `Markup` stays as it is.
    """
    from markupsafe import Markup, escape

    if hasattr(text, "__html__"):
        return escape(text)
    return Markup("<wbr>").join(_BREAK_POINTS.split(text))


def path_in_address(text: str) -> str:
    """Return a token quoted as the path of an address."""
    return quote(text, safe="/")


def png_address(content: bytes) -> str:
    """Return a PNG picture as an address that contains it."""
    return f"data:image/png;base64,{base64.b64encode(content).decode('ascii')}"


def scalar(value: Any) -> str:
    """Return a value as text: numbers with few digits, a dash if unknown, `none` if empty."""
    if isinstance(value, list | tuple | Mapping) and not value:
        return "none"
    if isinstance(value, list | tuple):
        return _join_texts(value, scalar)
    if isinstance(value, Mapping):
        return ", ".join(f"{name}: {scalar(member)}" for name, member in value.items())
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return with_minus(f"{value:.{_MAX_DIGITS}g}" if isinstance(value, float) else str(value))


def result_text(value: Any) -> str:
    """Return a result as text: three decimals below 10, and three digits from 10 on.

    Whole numbers have no decimals; an unknown value is a dash.
    """
    if isinstance(value, list | tuple):
        return _join_texts(value, result_text)
    if isinstance(value, bool | str) or value is None or not math.isfinite(value):
        return scalar(value)
    if value == round(value) or abs(value) >= 1000:
        return with_minus(f"{value:,.0f}")
    if abs(value) < 10:
        return with_minus(f"{value:.3f}")
    return with_minus(f"{value:.3g}")


def _join_texts(values: Sequence[Any], format_value: Callable[[Any], str]) -> str:
    separator = ", "
    if any(isinstance(value, list | tuple) for value in values):
        separator = "; "
    return separator.join(map(format_value, values))
