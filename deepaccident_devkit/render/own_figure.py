"""The devkit's own classes of figures, and of tokens beneath titles.

The module imports matplotlib, so import it only where a figure is made.
"""

from functools import partial
from typing import Any

from matplotlib.figure import Figure  # noqa: TID253 - see above
from matplotlib.text import Annotation, Text  # noqa: TID253 - see above

from deepaccident_devkit.render.styles import current_style, own_settings


class OwnFigure(Figure):
    """A figure that always looks like its style, whatever the user's matplotlib settings are.

    Attributes:
        settings: Function that returns a context manager, which applies the style that was current
            when the figure was made.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Make a figure in the current style, with the same arguments as `Figure`."""
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


class TitleToken(Annotation):
    """A token over the lowest lines of a title, which vanishes when the title gets another text."""

    def __init__(self, token: str, title: Text, **style: Any) -> None:
        """Write a token in the middle of the lowest edge of a title."""
        self.title_text = title.get_text()
        super().__init__(
            token,
            (0.5, 0),
            xycoords=title,
            annotation_clip=False,
            ha="center",
            va="bottom",
            **style,
        )

    def get_visible(self) -> bool:
        """Return whether the token is rendered: not if its title has changed."""
        title: Any = self.xycoords
        return super().get_visible() and title.get_text() == self.title_text
