"""The colours of pages as variables of CSS, light and dark: greys, and mixes of the colour table."""

from __future__ import annotations

from typing import Final

from deepaccident_devkit.render.colors import GRID_COLOR, LINK_COLOR, WARNING_COLOR

LIGHT: Final = f"""
:root {{ color-scheme: light; --paper: #fff; --ink: #1c1c1c; --soft: #444; --dim: #555; --line: #ececec;
  --rule: {GRID_COLOR}; --accent: {LINK_COLOR}; --caution: {WARNING_COLOR};
  --link: var(--accent); --warning: var(--caution); --block: #f3f3f3; --edge: #999; }}
"""
DARK: Final = """
@media screen and (prefers-color-scheme: dark) {
  :root { color-scheme: dark; --paper: #181818; --ink: #e8e8e8; --soft: #c9c9c9; --dim: #a8a8a8; --line: #333;
    --rule: #535353; --link: color-mix(in srgb, var(--accent) 40%, #fff);
    --warning: color-mix(in srgb, var(--caution) 40%, #fff); --block: #292929; --edge: #777; }
}
"""
"""For readers whose system is dark; after `LIGHT`."""
