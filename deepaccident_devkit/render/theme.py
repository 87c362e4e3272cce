"""The style of pages; its colours, light and dark, are greys and mixes of the colour table."""

from __future__ import annotations

from typing import Final

from deepaccident_devkit.pages import part
from deepaccident_devkit.render.colors import GRID_COLOR, LINK_COLOR, WARNING_COLOR

COLORS: Final = f"""
:root {{ color-scheme: light; --paper: #fff; --ink: #1c1c1c; --soft: #444; --dim: #555; --line: #ececec;
  --rule: {GRID_COLOR}; --accent: {LINK_COLOR}; --caution: {WARNING_COLOR};
  --link: var(--accent); --warning: var(--caution); --block: #f3f3f3; --edge: #999; }}
@media screen and (prefers-color-scheme: dark) {{
  :root {{ color-scheme: dark; --paper: #181818; --ink: #e8e8e8; --soft: #c9c9c9; --dim: #a8a8a8; --line: #333;
    --rule: #535353; --link: color-mix(in srgb, var(--accent) 40%, #fff);
    --warning: color-mix(in srgb, var(--caution) 40%, #fff); --block: #292929; --edge: #777; }}
}}
"""
"""Dark for readers whose system is."""


def page_style() -> str:
    """The rules of all pages but replays."""
    return COLORS + part("pages.css")
