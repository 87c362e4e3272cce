"""A figure of a run, and the file that it becomes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

from deepaccident_devkit._version import __version__
from deepaccident_devkit.evaluation.runs import EvaluationRun
from deepaccident_devkit.files import replacing
from deepaccident_devkit.render.axes import detached_figure
from deepaccident_devkit.render.colors import WARNING_COLOR
from deepaccident_devkit.render.evaluation.panels import PANEL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_DPI: Final = 130
_ROW: Final = 0.36
"""Inches that a bar needs at least."""
MAIN_NUMBERS: Final = {
    "motion": ("ranges/100x100/pq", "ranges/100x100/iou"),
    "accident": ("apa", "position_error"),
    "detection": ("mean_average_precision",),
    "warning": ("warned_share",),
}
"""Task → paths of the headline numbers that figures show by attribute: the first by all attributes, and samples are
ranked by it; the others by time to impact alone."""


class Draw(Protocol):
    """Draws on axes, and returns them."""

    def __call__(self, *, ax: Axes) -> Axes:
        """Draw."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunFigure:
    """One figure of a run.

    Attributes:
        name: of its file, without the ending.
        caption: what is to be seen, for the reader of the report.
        alt: the same in words and numbers, for who does not see it.
        draw: draws it on axes.
        rows: how many bars are below each other; the figure is higher for many.
    """

    name: str
    caption: str
    alt: str
    draw: Draw
    rows: int = 0


def save_figure(run: EvaluationRun, drawn: RunFigure, folder: Path) -> Path:
    """Draw a figure of a run into a PNG file, atomically, over one that is there.

    Args:
        run: of `evaluate_results`.
        drawn: one of its figures.
        folder: where; it is made if it is not there.

    Returns:
        The file's path. The figure says the task, protocol, devkit and release that it is of, and in red what is
        missing of a partial run.
    """
    path = folder / f"{drawn.name}.png"
    figure = detached_figure((PANEL[0], max(PANEL[1], _ROW * drawn.rows + 1.2)))
    drawn.draw(ax=figure.add_subplot())
    made_of = (
        f"{run.setup.task}, protocol {run.setup.protocol}, devkit {__version__}, release {run.release.fingerprint}"
    )
    figure.supxlabel(made_of, fontsize=6, color="#666666")
    mark = "" if run.partial is None else run.partial.text()
    if mark:
        figure.suptitle(mark, color=WARNING_COLOR, fontsize=10, fontweight="bold")
    with replacing(path) as temporary:
        said = {"Title": drawn.name, "Description": f"{mark} {made_of}".strip()}
        figure.savefig(temporary, format="png", dpi=_DPI, metadata=said)
    return path
