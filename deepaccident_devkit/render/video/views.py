"""The views that a video can show, each rendered on a figure of its own, and a frame of them side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.arrays import ByteArray
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.render.accident import draw_countdown
from deepaccident_devkit.render.bev import BEV_LAYERS, render_bev
from deepaccident_devkit.render.calibration import CALIBRATION_LAYERS, render_calibration
from deepaccident_devkit.render.camera import CAMERA_DEFAULT, CAMERA_LAYERS, draw_camera
from deepaccident_devkit.render.layers import LAYERS, Layer, layers_of
from deepaccident_devkit.render.moments import MOMENT_LAYERS, draw_shared_moment, render_sample
from deepaccident_devkit.render.motion import TRAIL_LAYERS, render_motion_labels
from deepaccident_devkit.render.pair import PAIR_LAYERS
from deepaccident_devkit.render.pictures import figure_of_pixels
from deepaccident_devkit.render.roles import in_drawing_order
from deepaccident_devkit.render.styles import in_own_settings
from deepaccident_devkit.render.visibility import VISIBILITY_LAYERS, render_visibility, render_visibility_matrix
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import CAMERAS
from deepaccident_devkit.text import choice
from deepaccident_devkit.v2x import Agents, cooperating_agents

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from deepaccident_devkit.tables.records import FrameRecord

OwnView = Callable[[Dataset, "FrameRecord", "Figure"], object]
"""Renders a moment, given by its record, on an empty figure; its result is not used."""
_DPI: Final = 100.0
_DPI_AT: Final = 1280 * 720
"""A picture with so many pixels has `_DPI` pixels an inch; larger ones have more, so words keep their share."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moment:
    """What a view renders.

    Attributes:
        dataset: the release.
        frame: token.
        agents: as in `cooperating_agents`.
        names: the names of these agents; the first one is the agent whose view it is.
        layers: None for the view's default.
    """

    dataset: Dataset
    frame: str
    agents: Agents
    names: tuple[str, ...]
    layers: tuple[Layer, ...] | None

    @property
    def sample(self) -> str:
        """The token of the first agent's sample."""
        scenario, number = self.frame.rsplit("/", 1)
        return sample_token(scenario, self.names[0], int(number))


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """One way to render a moment.

    Attributes:
        draw: renders on an empty figure.
        layers: the layers that it has.
        share: of a picture's width, if there are several views.
        inches: width that it needs for its words; if there is less, they become smaller.
        own: the caller's function that `draw` calls, if there is one.
    """

    draw: Callable[[Moment, Figure], object]
    layers: tuple[Layer, ...] = LAYERS
    share: int = 1
    inches: float = 4.2
    own: OwnView | None = None


def _frame(moment: Moment, fig: Figure) -> None:
    draw_shared_moment(moment.dataset, moment.frame, in_drawing_order(moment.names), moment.layers, fig)


def _sample(moment: Moment, fig: Figure) -> object:
    return render_sample(moment.dataset, moment.sample, agents=moment.agents, layers=moment.layers, fig=fig)


def _bev(moment: Moment, fig: Figure) -> object:
    ax = fig.add_subplot()
    return render_bev(moment.dataset, moment.sample, agents=moment.agents, layers=moment.layers, ax=ax)


def _visibility(moment: Moment, fig: Figure) -> object:
    ax = fig.add_subplot()
    return render_visibility(moment.dataset, moment.sample, agents=moment.agents, layers=moment.layers, ax=ax)


def _visibility_matrix(moment: Moment, fig: Figure) -> object:
    return render_visibility_matrix(moment.dataset, moment.sample, agents=moment.agents, ax=fig.add_subplot())


def _accident(moment: Moment, fig: Figure) -> None:
    draw_countdown(moment.dataset, moment.frame, moment.names, moment.layers, fig)


def _calibration(moment: Moment, fig: Figure) -> object:
    return render_calibration(moment.dataset, moment.frame, agents=moment.agents, layers=moment.layers, fig=fig)


def _labels(moment: Moment, fig: Figure) -> object:
    return render_motion_labels(moment.dataset, moment.sample, style="trail", layers=moment.layers, fig=fig)


@dataclass(frozen=True, slots=True)
class _Camera:
    channel: str

    def __call__(self, moment: Moment, fig: Figure) -> object:
        camera = f"{moment.sample}/{self.channel}"
        layers = CAMERA_DEFAULT if moment.layers is None else moment.layers
        return draw_camera(moment.dataset, moment.dataset.get("sample_data", camera), layers, fig.add_subplot())


@dataclass(frozen=True, slots=True)
class _Own:
    draw: OwnView

    def __call__(self, moment: Moment, fig: Figure) -> object:
        dataset = moment.dataset
        return self.draw(dataset, dataset.frame[dataset.getind("frame", moment.frame)], fig)


VIEWS: Final[Mapping[str, View]] = {
    "frame": View(draw=_frame, layers=MOMENT_LAYERS, share=2, inches=12.8),
    "sample": View(draw=_sample, layers=MOMENT_LAYERS, share=2, inches=12.8),
    "accident": View(draw=_accident, layers=PAIR_LAYERS, share=2, inches=12.8),
    "bev": View(draw=_bev, layers=BEV_LAYERS, inches=4.6),
    "visibility": View(draw=_visibility, layers=VISIBILITY_LAYERS),
    "visibility_matrix": View(draw=_visibility_matrix, layers=()),
    "calibration": View(draw=_calibration, layers=CALIBRATION_LAYERS, share=2, inches=12.0),
    "labels": View(draw=_labels, layers=TRAIL_LAYERS, inches=5.5),
    **{channel: View(draw=_Camera(channel), layers=CAMERA_LAYERS) for channel in CAMERAS},
}
"""The views by name; cameras are those of the first agent."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """How every frame of a video is rendered.

    Attributes:
        dataset: the release.
        views: side by side, each with the layers that it renders.
        agents: as in `cooperating_agents`.
        width: pixels.
        height: pixels.
    """

    dataset: Dataset
    views: tuple[tuple[View, tuple[Layer, ...] | None], ...]
    agents: Agents
    width: int
    height: int

    def picture(self, frame: str) -> ByteArray:
        """Render the moment of a frame's token; (height, width, 3) uint8, RGB."""
        names = names_at(self.dataset, frame, self.agents)
        total, left, parts = sum(view.share for view, _ in self.views), 0, []
        for number, (view, layers) in enumerate(self.views):
            shares = sum(each.share for each, _ in self.views[: number + 1])
            right = round(self.width * shares / total)
            moment = Moment(dataset=self.dataset, frame=frame, agents=self.agents, names=names, layers=layers)
            parts.append(self._drawn(view, moment, right - left))
            left = right
        return np.hstack(parts)

    @in_own_settings
    def _drawn(self, view: View, moment: Moment, width: int) -> ByteArray:
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        dpi = min(_DPI * (self.width * self.height / _DPI_AT) ** 0.5, width / view.inches)
        fig = figure_of_pixels(width, self.height, dpi=dpi)
        view.draw(moment, fig)
        canvas: Any = FigureCanvasAgg(fig)
        canvas.draw()
        drawn: ByteArray = np.asarray(canvas.buffer_rgba())[..., :3].copy()
        return drawn


def names_at(dataset: Dataset, frame: str, agents: Agents) -> tuple[str, ...]:
    """The chosen agents at a frame; first is the one whose view it is: the first one named, or the first one there."""
    first = dataset.samples_of(frame)[0]
    names = cooperating_agents(dataset, first, agents)
    if agents is None or isinstance(agents, str) or not isinstance(agents, Sequence):
        return names
    return tuple(sorted(names, key=lambda name: name != agents[0]))


def views_of(
    what: str | OwnView | Iterable[str | OwnView], layers: Iterable[Layer] | None
) -> tuple[tuple[View, tuple[Layer, ...] | None], ...]:
    """The named views, each with those of the layers that it has; raises ChoiceError."""
    given: list[Any] = [what] if isinstance(what, str) or callable(what) else list(what)
    if not given:
        raise ChoiceError(f"what: expected at least one of {', '.join(VIEWS)}, found none")
    views = [_view(each) for each in given]
    possible = [layer for layer in LAYERS if any(layer in view.layers for view in views)]
    chosen = layers_of(layers, (), possible)
    if layers is None:
        return tuple((view, None) for view in views)
    return tuple((view, tuple(layer for layer in view.layers if layer in chosen)) for view in views)


def _view(given: object) -> View:
    if callable(given):
        return View(draw=_Own(given), layers=(), own=given)
    return VIEWS[choice("what", given, VIEWS)]
