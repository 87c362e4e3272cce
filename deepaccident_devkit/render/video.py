"""A scenario as a video: any of the views, frame by frame, one view or several side by side."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.render.accident import PAIR_LAYERS, draw_countdown
from deepaccident_devkit.render.beside import Beside, beside_models, beside_twin, draw_described
from deepaccident_devkit.render.bev import BEV_LAYERS, render_bev
from deepaccident_devkit.render.camera import CAMERA_DEFAULT, CAMERA_LAYERS, draw_camera
from deepaccident_devkit.render.captions import has_sensor_file
from deepaccident_devkit.render.figures import (
    LAYERS,
    Layer,
    Layers,
    figure_of_pixels,
    laid_out,
    layers_of,
)
from deepaccident_devkit.render.moments import default_agent
from deepaccident_devkit.render.motion import TRAIL_LAYERS, render_motion_labels
from deepaccident_devkit.render.samples import (
    CALIBRATION_LAYERS,
    MOMENT_LAYERS,
    draw_shared_moment,
    render_calibration,
    render_sample,
)
from deepaccident_devkit.render.styles import current_style, own_settings, using_style
from deepaccident_devkit.render.turntable import draw_turntable
from deepaccident_devkit.render.visibility import (
    VISIBILITY_LAYERS,
    render_visibility,
    render_visibility_matrix,
)
from deepaccident_devkit.support.arrays import ByteArray
from deepaccident_devkit.support.files import replacing
from deepaccident_devkit.support.mp4 import check_pyav, write_mp4
from deepaccident_devkit.support.parallel import Engine, Places, in_order, run_unordered
from deepaccident_devkit.support.text import PathType, choice, path_of
from deepaccident_devkit.tables.tokens import frame_token, sample_token
from deepaccident_devkit.taxonomy import BEV_CAMERA, CAMERAS, LIDAR
from deepaccident_devkit.v2x import Agents, cooperating_agents
from deepaccident_devkit.v2x.agents import checked_agents

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from PIL.Image import Image
    from typing_extensions import Unpack

    from deepaccident_devkit.evaluation.results import Results
    from deepaccident_devkit.tables.records import FrameRecord

_WEBP_QUALITY = 70
# Number of colours of a GIF; one more is reserved for pixels that do not change.
_GIF_COLORS = 255
# Approximate number of pixels from which the palette for all pictures is chosen.
_PALETTE_PIXELS = 2_000_000
# Function that renders a frame (a record) on an empty figure; its result is not used.
OwnView = Callable[[Dataset, "FrameRecord", "Figure"], object]
_DPI = 100.0
# Shares of a comparison's height: the verdicts above the views, and the strip below them.
_VERDICT_SHARE = 0.05
_STRIP_SHARE = 0.25
# The words of the two pictures are as large as if one of them filled the video.
_HALF_WORD_SCALE = 2**0.5
# Margin between views, in pixels.
_MARGIN_PX = 5
# Size in pixels of a picture at `_DPI` pixels per inch. Larger pictures have a higher resolution,
# so that words keep their relative size.
_REFERENCE_PIXELS = 1280 * 720


def check_target(path: Path, *, size: tuple[int, int], fps: float) -> None:
    """Check before any rendering that a video can be written to this path.

    Raises ChoiceError if the path, suffix, size or rate is not possible, and MissingExtraError if
    the extra `video` is needed but not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ChoiceError(f"{path}: expected a file that ends in {', '.join(SUFFIXES)}")
    if path.is_dir():
        raise ChoiceError(f"{path}: is a folder; give a file")
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    if not os.access(folder, os.W_OK):
        raise ChoiceError(f"{path}: nothing can be written into {folder}; choose another folder")
    if not 0 < fps <= 100:
        raise ChoiceError(
            f"fps: expected frames per second, above 0 and at most 100, found {fps!r}"
        )
    if min(size) < 16:
        raise ChoiceError(f"size: expected width and height of at least 16 pixels, found {size}")
    if suffix == ".mp4":
        check_pyav(f"{path}: MP4", ", or choose .gif or .webp")


def write_video(path: Path, pictures: Iterable[ByteArray], *, fps: float) -> None:
    """Write pictures, (H, W, 3) uint8 RGB of one size, in the video format of the path's suffix.

    The file is written atomically. There must be at least one picture; for MP4, H and W must be
    even.
    """
    with replacing(path) as temporary:
        write = SUFFIXES[path.suffix.lower()]
        write(temporary, pictures, fps)


def _write_gif(path: Path, pictures: Iterable[ByteArray], fps: float) -> None:
    """Write a GIF with one palette for all pictures, without dithering.

    Pixels that stay the same are stored once and do not flicker.
    """
    from PIL import Image

    arrays = list(pictures)
    pixels = sum(array.size / 3 for array in arrays)
    step = max(1, round((pixels / _PALETTE_PIXELS) ** 0.5))
    colors = [array[::step, ::step].reshape(-1, 3) for array in arrays]
    samples = np.concatenate(colors)
    palette = Image.fromarray(samples[None]).quantize(_GIF_COLORS, Image.Quantize.MAXCOVERAGE)
    images = []
    for array in arrays:
        image = Image.fromarray(array)
        images.append(image.quantize(palette=palette, dither=Image.Dither.NONE))
    _save_animation(path, images, fps, format="GIF", optimize=True)


def _write_webp(path: Path, pictures: Iterable[ByteArray], fps: float) -> None:
    from PIL import Image

    images = [Image.fromarray(picture) for picture in pictures]
    _save_animation(path, images, fps, format="WEBP", quality=_WEBP_QUALITY, method=4)


def _save_animation(path: Path, images: Sequence[Image], fps: float, **options: Any) -> None:
    """Write pillow's images as an animation that repeats forever."""
    duration_ms = round(1000 / fps)
    images[0].save(
        path, save_all=True, append_images=images[1:], duration=duration_ms, loop=0, **options
    )


# Function that writes each kind of file, by suffix.
SUFFIXES: Final[Mapping[str, Callable[[Path, Iterable[ByteArray], float], None]]] = {
    ".mp4": write_mp4,
    ".gif": _write_gif,
    ".webp": _write_webp,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class _View:
    """One way to render a moment.

    Attributes:
        draw: Function that takes a release and a token, as the functions of this package do.
        row_kind: What the token names: the moment's `frame`, or the first agent's `sample`.
        canvas: `fig` if the function renders on an empty figure, `ax` if it renders on axes.
        options: Names of the video's options that the function takes.
        channels: Sensors that the view of one agent shows.
        layers: Layers that the view supports.
        share: Share of the picture's width, if there are several views.
        inches: Width that the view's words need; in less, they become smaller.
        is_own: Whether the function is the caller's own, which takes a release, a frame record
            and a figure.
    """

    draw: Callable[..., object]
    row_kind: Literal["frame", "sample"] = "sample"
    canvas: Literal["fig", "ax"] = "fig"
    options: tuple[str, ...] = ("agents", "layers")
    layers: Layers = LAYERS
    channels: tuple[str, ...] = ()
    share: int = 1
    inches: float = 4.2
    is_own: bool = False

    def render(
        self,
        fig: Figure,
        dataset: Dataset,
        frame: str,
        agents: Sequence[str],
        layers: Layers | None,
    ) -> None:
        """Render a moment on an empty figure.

        Args:
            fig: Empty figure to render on.
            dataset: The release.
            frame: Token of the moment's frame.
            agents: Names of agents; a view of one agent shows the first.
            layers: Layers; None for the view's default.
        """
        if self.is_own:
            self.draw(dataset, dataset.frame[dataset.getind("frame", frame)], fig)
            return
        token = frame
        if self.row_kind == "sample":
            scenario, number = frame.rsplit("/", 1)
            token = sample_token(scenario, agents[0], int(number))
        values = {"agents": agents, "layers": layers}
        arguments: dict[str, Any] = {name: values[name] for name in self.options}
        arguments[self.canvas] = fig if self.canvas == "fig" else fig.add_subplot()
        self.draw(dataset, token, **arguments)


def _draw_channel(
    channel: str, dataset: Dataset, sample: str, *, layers: Layers | None, ax: Axes
) -> None:
    camera = dataset.get("sample_data", f"{sample}/{channel}")
    if layers is None:
        layers = CAMERA_DEFAULT
    draw_camera(dataset, camera, layers, ax)


# Views by name; a view of a camera shows the camera of the first agent.
VIEWS: Final[Mapping[str, _View]] = {
    "frame": _View(
        draw=draw_shared_moment, row_kind="frame", layers=MOMENT_LAYERS, share=2, inches=12.8
    ),
    "sample": _View(
        draw=render_sample, layers=MOMENT_LAYERS, channels=(*CAMERAS, LIDAR), share=2, inches=12.8
    ),
    "accident": _View(
        draw=draw_countdown, row_kind="frame", layers=PAIR_LAYERS, share=2, inches=12.8
    ),
    "bev": _View(
        draw=render_bev,
        canvas="ax",
        layers=BEV_LAYERS,
        channels=(LIDAR, BEV_CAMERA),
        inches=4.6,
    ),
    "visibility": _View(draw=render_visibility, canvas="ax", layers=VISIBILITY_LAYERS),
    "visibility_matrix": _View(
        draw=render_visibility_matrix, canvas="ax", options=("agents",), layers=()
    ),
    "calibration": _View(
        draw=render_calibration, row_kind="frame", layers=CALIBRATION_LAYERS, share=2, inches=12.0
    ),
    "turntable": _View(
        draw=draw_turntable,
        row_kind="frame",
        options=("agents",),
        layers=(),
        channels=(LIDAR,),
        share=2,
        inches=8.0,
    ),
    "labels": _View(
        draw=partial(render_motion_labels, style="trail"),
        options=("layers",),
        layers=("bev", *TRAIL_LAYERS),
        inches=5.5,
    ),
    **{
        channel: _View(
            draw=partial(_draw_channel, channel),
            canvas="ax",
            options=("layers",),
            layers=CAMERA_LAYERS,
            channels=(channel,),
        )
        for channel in CAMERAS
    },
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VideoScene:
    """How every frame of a video is rendered.

    Attributes:
        dataset: The release.
        views: Views side by side, each with its layers.
        agents: Agents, as in `cooperating_agents`.
        width: Width of the picture, pixels.
        height: Height of the picture, pixels.
        view_agent: Agent that views of one agent show; None for the first of `agents`.
        style: Style of the pictures, by default the current one.
        word_scale: Size of the words, relative to those in a picture of this size.
    """

    dataset: Dataset
    views: tuple[tuple[_View, Layers | None], ...]
    agents: Agents
    width: int
    height: int
    view_agent: str | None = None
    style: Any = field(default_factory=current_style)
    word_scale: float = 1.0

    def picture(self, frame: str) -> ByteArray:
        """Render the moment of a frame's token; (height, width, 3) uint8, RGB."""
        names = names_at(self.dataset, frame, self.agents, self.view_agent)
        image = self._image_only(frame, names[0])
        if image is not None:
            return image
        total_share = sum(view.share for view, _ in self.views)
        share = 0
        start = 0
        pictures = []
        for view, layers in self.views:
            share += view.share
            end = round(self.width * share / total_share)
            fig = self.figure(view, end - start, frame, names, layers)
            pictures.append(_picture_of(fig))
            start = end
        return np.hstack(pictures)

    def _image_only(self, frame: str, agent: str) -> ByteArray | None:
        """Return an image that fills the picture, if it is the only layer of the only view.

        It keeps its aspect ratio, so there may be white strips at two edges.
        """
        from PIL import Image, ImageOps

        (view, layers), *other_views = self.views
        if other_views or layers != ("image",) or len(view.channels) != 1:
            return None
        (channel,) = view.channels
        scenario, number = frame.rsplit("/", 1)
        camera = f"{sample_token(scenario, agent, int(number))}/{channel}"
        if not has_sensor_file(self.dataset, camera):
            return None
        image = Image.fromarray(self.dataset.load_image(camera))
        size = (self.width, self.height)
        return np.asarray(ImageOps.pad(image, size, Image.Resampling.LANCZOS, color="white"))

    @property
    def dpi(self) -> float:
        """Pixels per inch of the words."""
        scale = (self.width * self.height / _REFERENCE_PIXELS) ** 0.5
        return float(_DPI * scale * self.word_scale)

    def figure(
        self,
        view: _View,
        width: int,
        frame: str,
        agents: Sequence[str],
        layers: Layers | None,
    ) -> Figure:
        """Render one view of a moment on a figure of a width in pixels."""
        dpi = min(self.dpi, width / view.inches)
        with using_style(self.style), own_settings():
            fig = figure_of_pixels(width, self.height, dpi=dpi)
            layout: Any = fig.get_layout_engine()
            layout.set(w_pad=_MARGIN_PX / dpi)
            view.render(fig, self.dataset, frame, agents, layers)
        return fig


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _BesideScene:
    """How every frame of a video of two sides is rendered.

    Attributes:
        scene: Size and style of the whole picture; its views show recordings.
        beside: The two sides.
    """

    scene: VideoScene
    beside: Beside

    def picture(self, number: int) -> ByteArray:
        """Render a frame number of both sides; (height, width, 3) uint8, RGB."""
        width = self.scene.width
        verdict_height = round(self.scene.height * _VERDICT_SHARE)
        strip_height = round(self.scene.height * _STRIP_SHARE)
        view_height = self.scene.height - verdict_height - strip_height
        verdicts = []
        pictures = []
        for side, side_width in zip(
            self.beside.sides, (width // 2, width - width // 2), strict=True
        ):
            verdict = side.verdict(number)
            scene = replace(
                self.scene, width=side_width, height=view_height, word_scale=_HALF_WORD_SCALE
            )
            described = side.described(scene.dataset, number)
            if described is not None:
                verdict = f"{side.name}: {described.words.partition(': ')[2]}"
                view = _View(draw=partial(draw_described, described), is_own=True)
                scene = replace(scene, views=((view, None),))
            frame = frame_token(side.scenario, side.frame(number))
            pictures.append(scene.picture(frame))
            verdicts.append(verdict)
        with using_style(self.scene.style), own_settings():
            words = figure_of_pixels(width, verdict_height, dpi=self.scene.dpi)
            self.beside.write_verdicts(words, verdicts)
            strip = figure_of_pixels(width, strip_height, dpi=self.scene.dpi)
            self.beside.draw_times(strip.add_subplot(), number)
        return np.vstack([_picture_of(words), np.hstack(pictures), _picture_of(strip)])


def _picture_of(fig: Any) -> ByteArray:
    """Return a figure's pixels, (H, W, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas: Any = FigureCanvasAgg(fig)
    with laid_out(fig, fig.dpi):
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def names_at(
    dataset: Dataset, frame: str, agents: Agents, view_agent: str | None = None
) -> tuple[str, ...]:
    """Return the agents at a frame, starting with the one that views of one agent show.

    That agent is the first one in `agents`, otherwise `view_agent`, or the first present one.
    """
    first_sample = dataset.samples_of(frame)[0]
    names = cooperating_agents(dataset, first_sample, agents)
    checked = checked_agents(agents)
    first_agent = view_agent or names[0]
    if isinstance(checked, tuple):
        first_agent = checked[0]
    return tuple(sorted(names, key=first_agent.__ne__))


def views_of(
    names: str | OwnView | Iterable[str | OwnView], layers: Iterable[Layer] | None
) -> tuple[tuple[_View, Layers | None], ...]:
    """Return the named views, each with the requested layers that it supports.

    None leaves each view its default layers. Raises ChoiceError if a view is unknown, if there are
    no views, or if none of them supports a layer.
    """
    items: list[Any] = [names] if isinstance(names, str) or callable(names) else list(names)
    if not items:
        raise ChoiceError(f"what: expected at least one of {', '.join(VIEWS)}, found none")
    views = []
    for item in items:
        if callable(item):
            views.append(_View(draw=item, layers=(), is_own=True))
        else:
            views.append(VIEWS[choice("what", item, VIEWS)])
    possible = [layer for layer in LAYERS if any(layer in view.layers for view in views)]
    requested = layers_of(layers, (), possible)
    views_with_layers: list[tuple[_View, Layers | None]] = []
    for view in views:
        view_layers = tuple(layer for layer in view.layers if layer in requested)
        views_with_layers.append((view, None if layers is None else view_layers))
    return tuple(views_with_layers)


def render_scenario_video(  # noqa: PLR0913 - each is a choice that stands on its own in a notebook
    dataset: Dataset,
    scenario: RowArgument,
    path: PathType,
    *,
    views: str | OwnView | Iterable[str | OwnView] = "frame",
    beside: Literal["twin"] | Mapping[str, Results] | None = None,
    task: str | None = None,
    agents: Agents = None,
    layers: Iterable[Layer] | None = None,
    frames: Collection[int] | slice | None = None,
    size: tuple[int, int] = (1280, 720),
    fps: float = 10.0,
    **engine: Unpack[Engine],
) -> Path:
    """Write a scenario as a video.

    The views are named after the `render_…` functions: `frame` (the agents' front cameras next to
    one view from above), `sample` (six cameras), `bev`, `visibility`, `visibility_matrix`,
    `calibration`, `labels` (motion labels as a trail), `turntable` (the agents' points in three
    dimensions, from a camera that goes around them once), a camera by its channel, and `accident`
    (the countdown to the impact: five cameras, a view from above and the speeds). `frame`,
    `accident`, or two or three of the others side by side, fill a 16:9 picture.

    Args:
        dataset: The release.
        scenario: Token or record.
        path: Path of the file to write, in the format of its suffix: `.mp4` (with the extra
            `video`), `.gif` or `.webp`. An earlier file is replaced when the new one is complete.
        views: A view by name, a function (dataset, frame record, figure) that renders one, or
            several side by side. A single camera with only the layer `image` fills the picture.
        beside: `twin` shows an accident and its normal twin side by side, with one clock that
            counts down to the impact, verdicts and the pair's time to collision. `scenario` is
            either of the two, and `views` are shown of both: `bev` and cameras fit well. Results
            by the name of the model show the model's last prediction from above: one model is
            beside `views` of the recording, two models are side by side.
        task: Task that draws the results; None for their own.
        agents: Agents in the views, or None for all present ones. Views of one agent (`sample`,
            `bev`, cameras, …) show the first of them or, with None, the agent with the most files
            of their sensors; from above, they show the boxes and points of all `agents`.
        layers: Each view renders the layers that it supports; None means each view's default.
        frames: Frame numbers, from 1, in the order to show; or a slice of the list of all frames;
            or None for all.
        size: Width and height, pixels; for MP4, rounded down to even numbers. (`load_image` uses
            the order of arrays instead: height, width.)
        fps: Frames per second; the recordings have 10.
        **engine: Options of `parallel.Engine`, with a progress bar unless `progress` is False. By
            default, only this process calls view functions of your own; worker processes can also
            call them if they are importable from a module.

    Returns:
        The path of the file.

    Raises:
        TokenError: No such scenario.
        ChoiceError: No such view, layer, agent, frame or kind of file, or the file cannot have this
            size or rate.
        NotAvailableError: An agent is not in this release, the sample has no label, or the view is
            `accident` and the scenario has no collision, or there is no twin or no prediction.
        MissingExtraError: The file is an `.mp4`, and the extra `video` is not installed.
        WorkerError: As in `parallel.Engine`.
    """
    target = path_of(path)
    check_target(target, size=size, fps=fps)
    width, height = size
    if target.suffix.lower() == ".mp4":  # H.264 halves the resolution of colours
        width -= width % 2
        height -= height % 2
    scene_views = views_of(views, layers)
    record = dataset.get("scenario", scenario)
    last_frame = record["num_frames"]
    sides = None
    reads = dataset.places
    if isinstance(beside, Mapping):
        reads = (*reads, *(results.path for results in beside.values()))
        names = names_at(dataset, record["first_frame_token"], agents)
        sides = beside_models(dataset, record, beside, task=task, agents=names)
    elif beside is not None:
        choice("beside", beside, ("twin",))
        sides = beside_twin(dataset, record)
    if sides is not None:
        last_frame = sides.num_frames
    numbers = _frame_numbers(frames, last_frame)
    recorded_numbers = [min(number, record["num_frames"]) for number in numbers]
    tokens = [frame_token(record["token"], number) for number in recorded_numbers]
    names_at(dataset, tokens[0], agents)  # raises errors before any worker starts
    functions = [view.draw for view, _ in scene_views if view.is_own]
    channels = {channel for view, _ in scene_views for channel in view.channels}
    view_agent = None
    if agents is None and channels:
        view_agent = default_agent(dataset, record["token"], recorded_numbers, channels)
    scene = VideoScene(
        dataset=dataset,
        views=scene_views,
        agents=agents,
        width=width,
        height=height,
        view_agent=view_agent,
    )
    workers = _workers(functions, engine.get("workers"))
    options: Engine = {"progress": True, **engine, "workers": workers}
    render: Callable[[Any], ByteArray] = scene.picture
    items: Sequence[Any] = tokens
    if sides is not None:
        render = _BesideScene(scene=scene, beside=sides).picture
        items = numbers
    unordered = run_unordered(
        render,
        items,
        label="Rendering frames",
        places=Places(reads=reads),
        **options,
    )
    with closing(in_order(unordered)) as pictures:
        write_video(target, pictures, fps=fps)
    return target


def _frame_numbers(frames: Collection[int] | slice | None, last_frame: int) -> list[int]:
    """Return the numbers, from 1, of the requested frames; raise ChoiceError if one is unknown."""
    recorded = range(1, last_frame + 1)
    if frames is None or isinstance(frames, slice):
        numbers = list(recorded[frames] if frames else recorded)
    else:
        numbers = list(frames)
    wrong = [number for number in numbers if number not in recorded]
    if wrong or not numbers:
        example = wrong[0] if wrong else "none"
        raise ChoiceError(f"frames: expected numbers from 1 to {last_frame}, found {example}")
    return numbers


def _workers(functions: Sequence[Callable[..., object]], workers: int | None) -> int | None:
    """Return how many processes may render a video that uses the caller's functions.

    Raises:
        ChoiceError: A function cannot be sent to other processes.
    """
    if not functions or workers == 1:
        return workers
    if workers is None:
        return 1
    for function in functions:
        name = getattr(function, "__qualname__", "<")
        if function.__module__ == "__main__" or "<" in name:
            raise ChoiceError(
                f"workers: {name} cannot be sent to other processes; "
                "put it into a module of its own, or pass workers=1"
            )
    return workers
