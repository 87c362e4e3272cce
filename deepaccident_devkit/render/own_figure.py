"""The devkit's own kind of figure. The module imports matplotlib, so it is imported where a figure is made."""

from __future__ import annotations

from functools import partial
from typing import Any

from matplotlib.figure import Figure  # noqa: TID253 - see above

from deepaccident_devkit.render.styles import current_style, own_settings


class OwnFigure(Figure):
    """A figure that looks as its style says, and no setting of the user counts, when it is made or later.

    Attributes:
        settings: gives the settings, for `with`, of the style that was the current one when the figure was made.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Take what `Figure` takes."""
        self.settings = partial(own_settings, current_style())
        with self.settings():
            super().__init__(*arguments, **options)

    def add_subplot(self, *arguments: Any, **options: Any) -> Any:
        """Add axes; `subplots` does it with this too."""
        with self.settings():
            return super().add_subplot(*arguments, **options)

    def draw(self, renderer: Any) -> None:
        """Render it on a canvas."""
        with self.settings():
            super().draw(renderer)

    def savefig(self, *arguments: Any, **options: Any) -> None:
        """Write it into a file."""
        with self.settings():
            super().savefig(*arguments, **options)
