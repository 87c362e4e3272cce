"""The devkit's own class of figures.

The module imports matplotlib, so it is imported where a figure is made.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from matplotlib.figure import Figure  # noqa: TID253 - see above

from deepaccident_devkit.render.styles import current_style, own_settings


class OwnFigure(Figure):
    """A figure in the look of its style; no setting of the user counts, when it is made or later.

    Attributes:
        settings: Function that returns the settings, for `with`, of the current style when the
            figure was made.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Make a figure from the arguments of `Figure`."""
        self.settings = partial(own_settings, current_style())
        with self.settings():
            super().__init__(*arguments, **options)

    def add_subplot(self, *arguments: Any, **options: Any) -> Any:
        """Add axes; `subplots` also calls this."""
        with self.settings():
            return super().add_subplot(*arguments, **options)

    def draw(self, renderer: Any) -> None:
        """Render the figure on a canvas."""
        with self.settings():
            super().draw(renderer)

    def savefig(self, *arguments: Any, **options: Any) -> None:
        """Write the figure into a file."""
        with self.settings():
            super().savefig(*arguments, **options)
