"""A scenario as a video: any of the views, frame by frame, one view or several side by side."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError, MissingExtraError
from deepaccident_devkit.render.accident import PAIR_LAYERS, draw_countdown
from deepaccident_devkit.render.bev import BEV_LAYERS, render_bev
from deepaccident_devkit.render.camera import CAMERA_DEFAULT, CAMERA_LAYERS, draw_camera
from deepaccident_devkit.render.figures import LAYERS, Layer, figure_of_pixels, layers_of
from deepaccident_devkit.render.motion import TRAIL_LAYERS, render_motion_labels
from deepaccident_devkit.render.samples import (
    CALIBRATION_LAYERS,
    MOMENT_LAYERS,
    draw_shared_moment,
    render_calibration,
    render_sample,
)
from deepaccident_devkit.render.styles import in_own_settings
from deepaccident_devkit.render.visibility import (
    VISIBILITY_LAYERS,
    render_visibility,
    render_visibility_matrix,
)
from deepaccident_devkit.support.arrays import ByteArray
from deepaccident_devkit.support.files import replacing
from deepaccident_devkit.support.parallel import Engine, Places, in_order, run_unordered
from deepaccident_devkit.support.text import choice, path_of
from deepaccident_devkit.tables.tokens import frame_token, sample_token
from deepaccident_devkit.taxonomy import CAMERAS
from deepaccident_devkit.v2x import Agents, cooperating_agents
from deepaccident_devkit.v2x.agents import checked_agents

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from PIL.Image import Image
    from typing_extensions import Unpack

    from deepaccident_devkit.tables.records import FrameRecord

# Quality of H.264: 0 loses nothing, 51 is the worst.
_CRF: Final = "20"
_WEBP_QUALITY: Final = 70
# Colours of a GIF; one more is reserved for pixels that do not change.
_GIF_COLORS: Final = 255
# Pixels of all pictures, about, that are used to choose the palette.
_PALETTE_PIXELS: Final = 2_000_000
# Renders a moment, by its record, on an empty figure; its result is not used.
OwnView = Callable[[Dataset, "FrameRecord", "Figure"], object]
_DPI: Final = 100.0
# Pixels of the margin beside a view.
_MARGIN_PX: Final = 5
# Pixels of a picture with `_DPI` pixels an inch; larger ones have more, so words keep their share.
_REFERENCE_PIXELS: Final = 1280 * 720


def check_target(path: Path, *, size: tuple[int, int], fps: float) -> None:
    """Check before any rendering that the file can be written.

    Raises ChoiceError and MissingExtraError.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ChoiceError(
            f"path: expected a file that ends in {', '.join(SUFFIXES)}, found {str(path)!r}"
        )
    if path.is_dir():
        raise ChoiceError(f"path: expected a file, found the folder {path}")
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    if not os.access(folder, os.W_OK):
        raise ChoiceError(f"path: nothing can be written into {folder}; choose another folder")
    if not 0 < fps <= 100:
        raise ChoiceError(f"fps: expected frames a second, above 0 and at most 100, found {fps!r}")
    if min(size) < 16:
        raise ChoiceError(f"size: expected width and height of at least 16 pixels, found {size}")
    if suffix == ".mp4":
        _check_mp4(path, size)


def _check_mp4(path: Path, size: tuple[int, int]) -> None:
    if any(side % 2 for side in size):
        even = tuple(side - side % 2 for side in size)
        raise ChoiceError(
            f"size: expected an even width and height, which MP4 needs, found {size}; give {even}"
        )
    try:
        import av  # noqa: F401 - whether it is installed
    except ImportError:
        raise MissingExtraError(
            f"{path}: MP4 needs PyAV: in a checkout, pip install '.[video]'; "
            "or choose .gif or .webp"
        ) from None


def write_video(path: Path, pictures: Iterable[ByteArray], *, fps: float) -> None:
    """Write pictures, (H, W, 3) uint8 RGB of one size, in the video format of the path's suffix.

    The file is written atomically. H and W are even for MP4; there is at least one picture.
    """
    with replacing(path) as temporary:
        SUFFIXES[path.suffix.lower()](temporary, pictures, fps)


def _write_mp4(path: Path, pictures: Iterable[ByteArray], fps: float) -> None:
    """Write H.264 in yuv420p with its index in front.

    Browsers play it, and begin before it is complete.
    """
    import av

    options = {"movflags": "+faststart"}
    with av.open(os.fspath(path), "w", format="mp4", options=options) as container:
        stream = None
        for picture in pictures:
            if stream is None:
                stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"
                # in a virtual machine, x264's code for AVX-512 made other bytes in 2 of 100 files
                # of the same pictures
                stream.options = {"crf": _CRF, "x264-params": "asm=sse4.2"}
                stream.codec_context.thread_count = 1  # the bytes depend on the number of threads
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        if stream is not None:
            container.mux(stream.encode(None))


def _write_gif(path: Path, pictures: Iterable[ByteArray], fps: float) -> None:
    """Write a GIF with one palette for all pictures, without dithering.

    Pixels that stay the same are stored once and do not flicker.
    """
    from PIL import Image

    arrays = list(pictures)
    pixels = sum(array.size / 3 for array in arrays)
    step = max(1, round((pixels / _PALETTE_PIXELS) ** 0.5))
    samples = np.concatenate([array[::step, ::step].reshape(-1, 3) for array in arrays])
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


# Suffix → the writer of such files.
SUFFIXES: Final[Mapping[str, Callable[[Path, Iterable[ByteArray], float], None]]] = {
    ".mp4": _write_mp4,
    ".gif": _write_gif,
    ".webp": _write_webp,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class _View:
    """One way to render a moment.

    Attributes:
        draw: Function that renders the row of a token of a release, as the functions of this
            package do.
        row_kind: Kind of its row: the moment's `frame`, or the first agent's `sample`.
        canvas: `fig` if it renders on an empty figure, `ax` if on axes.
        options: Names of the video's options that it uses.
        layers: Layers that it has.
        share: Share of a picture's width, if there are several views.
        inches: Width that its words need; if there is less, they become smaller.
        is_own: Whether it is a caller's function, with the arguments release, frame record and
            figure.
    """

    draw: Callable[..., object]
    row_kind: Literal["frame", "sample"] = "sample"
    canvas: Literal["fig", "ax"] = "fig"
    options: tuple[str, ...] = ("agents", "layers")
    layers: tuple[Layer, ...] = LAYERS
    share: int = 1
    inches: float = 4.2
    is_own: bool = False

    def render(
        self,
        fig: Figure,
        dataset: Dataset,
        frame: str,
        agents: Sequence[str],
        layers: tuple[Layer, ...] | None,
    ) -> None:
        """Render a moment, by its frame's token, on an empty figure.

        Args:
            fig: The figure.
            dataset: The release.
            frame: Token.
            agents: Names; the view is that of the first agent.
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
    channel: str, dataset: Dataset, sample: str, *, layers: tuple[Layer, ...] | None, ax: Axes
) -> None:
    camera = dataset.get("sample_data", f"{sample}/{channel}")
    draw_camera(dataset, camera, CAMERA_DEFAULT if layers is None else layers, ax)


# Name → view; the cameras are the first agent's.
VIEWS: Final[Mapping[str, _View]] = {
    "frame": _View(
        draw=draw_shared_moment, row_kind="frame", layers=MOMENT_LAYERS, share=2, inches=12.8
    ),
    "sample": _View(draw=render_sample, layers=MOMENT_LAYERS, share=2, inches=12.8),
    "accident": _View(
        draw=draw_countdown, row_kind="frame", layers=PAIR_LAYERS, share=2, inches=12.8
    ),
    "bev": _View(draw=render_bev, canvas="ax", layers=BEV_LAYERS, inches=4.6),
    "visibility": _View(draw=render_visibility, canvas="ax", layers=VISIBILITY_LAYERS),
    "visibility_matrix": _View(
        draw=render_visibility_matrix, canvas="ax", options=("agents",), layers=()
    ),
    "calibration": _View(
        draw=render_calibration, row_kind="frame", layers=CALIBRATION_LAYERS, share=2, inches=12.0
    ),
    "labels": _View(
        draw=partial(render_motion_labels, style="trail"),
        options=("layers",),
        layers=TRAIL_LAYERS,
        inches=5.5,
    ),
    **{
        channel: _View(
            draw=partial(_draw_channel, channel),
            canvas="ax",
            options=("layers",),
            layers=CAMERA_LAYERS,
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
    """

    dataset: Dataset
    views: tuple[tuple[_View, tuple[Layer, ...] | None], ...]
    agents: Agents
    width: int
    height: int

    def picture(self, frame: str) -> ByteArray:
        """Render the moment of a frame's token; (height, width, 3) uint8, RGB."""
        names = names_at(self.dataset, frame, self.agents)
        total_share = sum(view.share for view, _ in self.views)
        start, share, parts = 0, 0, []
        for view, layers in self.views:
            share += view.share
            end = round(self.width * share / total_share)
            parts.append(self._view_picture(view, end - start, frame, names, layers))
            start = end
        return np.hstack(parts)

    @in_own_settings
    def _view_picture(
        self,
        view: _View,
        width: int,
        frame: str,
        agents: Sequence[str],
        layers: tuple[Layer, ...] | None,
    ) -> ByteArray:
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        scale = (self.width * self.height / _REFERENCE_PIXELS) ** 0.5
        dpi = min(_DPI * scale, width / view.inches)
        fig: Any = figure_of_pixels(width, self.height, dpi=dpi)
        fig.get_layout_engine().set(w_pad=_MARGIN_PX / dpi)
        view.render(fig, self.dataset, frame, agents, layers)
        canvas: Any = FigureCanvasAgg(fig)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def names_at(dataset: Dataset, frame: str, agents: Agents) -> tuple[str, ...]:
    """Return the names of agents at a frame, beginning with the agent of the views.

    It is the first one in `agents`, or the first present one.
    """
    names = cooperating_agents(dataset, dataset.samples_of(frame)[0], agents)
    checked = checked_agents(agents)
    view_agent = checked[0] if isinstance(checked, tuple) else names[0]
    return tuple(sorted(names, key=view_agent.__ne__))


def views_of(
    names: str | OwnView | Iterable[str | OwnView], layers: Iterable[Layer] | None
) -> tuple[tuple[_View, tuple[Layer, ...] | None], ...]:
    """Return the named views, each with its layers of the requested ones; raises ChoiceError."""
    items: list[Any] = [names] if isinstance(names, str) or callable(names) else list(names)
    if not items:
        raise ChoiceError(f"what: expected at least one of {', '.join(VIEWS)}, found none")
    views = [_view(item) for item in items]
    possible = [layer for layer in LAYERS if any(layer in view.layers for view in views)]
    requested = layers_of(layers, (), possible)
    if layers is None:
        return tuple((view, None) for view in views)
    views_with_layers = []
    for view in views:
        view_layers = tuple(layer for layer in view.layers if layer in requested)
        views_with_layers.append((view, view_layers))
    return tuple(views_with_layers)


def _view(view: object) -> _View:
    if callable(view):
        return _View(draw=view, layers=(), is_own=True)
    return VIEWS[choice("what", view, VIEWS)]


def render_scenario_video(  # noqa: PLR0913 - each is a choice that stands on its own in a notebook
    dataset: Dataset,
    scenario: RowArgument,
    path: str | os.PathLike[str],
    *,
    views: str | OwnView | Iterable[str | OwnView] = "frame",
    agents: Agents = None,
    layers: Iterable[Layer] | None = None,
    frames: Collection[int] | slice | None = None,
    size: tuple[int, int] = (1280, 720),
    fps: float = 10.0,
    **engine: Unpack[Engine],
) -> Path:
    """Write a scenario as a video.

    The views are named after the `render_…` functions: `frame` (the agents' front cameras beside
    one view from above), `sample` (six cameras), `bev`, `visibility`, `visibility_matrix`,
    `calibration`, `labels` (motion labels as a trail), a camera by its channel, and `accident`: the
    countdown to the impact in five cameras, from above and in speeds. `frame`, `accident`, or two
    or three of the others side by side, fill a picture of 16 to 9.

    Args:
        dataset: The release.
        scenario: Token or record.
        path: Path of the file to write, in the format of its suffix: `.mp4` (with the extra
            `video`), `.gif` or `.webp`. An earlier file is replaced when the new one is complete.
        views: A view by name, a function (dataset, frame record, figure) that renders one, or
            several side by side.
        agents: Agents in the views, or None for all present ones. Views of one agent (`sample`,
            `bev`, cameras, …) show the first one of them, or the first present one; their boxes and
            points from above are of all of `agents`.
        layers: Each view renders the layers that it has; None for the default of each view.
        frames: Numbers of frames, from 1, in the requested order; or a slice of the list of all
            frames; None for all.
        size: Width and height, pixels; even numbers for MP4. `load_image` counts as arrays do:
            (height, width).
        fps: Frames a second; the recordings have 10.
        **engine: Options of `parallel.Engine`, with a bar unless `progress` is False. By default
            only this process calls functions of your own; other processes can do so if the
            functions are importable from a module.

    Returns:
        The path of the file.

    Raises:
        TokenError: No such scenario.
        ChoiceError: No such view, layer, agent, frame or kind of file, or the file cannot have this
            size or rate.
        NotAvailableError: An agent is not in this release, the sample has no label, or nobody
            collides and the view is `accident`.
        MissingExtraError: The file is an `.mp4`, and the extra `video` is not installed.
        WorkerError: As in `parallel.Engine`.
    """
    target, (width, height) = path_of(path), size
    check_target(target, size=(width, height), fps=fps)
    scene_views = views_of(views, layers)
    record = dataset.get("scenario", scenario)
    numbers = _numbers(frames, record["num_frames"])
    tokens = [frame_token(record["token"], number) for number in numbers]
    names_at(dataset, tokens[0], agents)  # raises errors before any worker starts
    functions = [view.draw for view, _ in scene_views if view.is_own]
    scene = VideoScene(
        dataset=dataset, views=scene_views, agents=agents, width=width, height=height
    )
    workers = _workers(functions, engine.get("workers"))
    options: Engine = {"progress": True, **engine, "workers": workers}
    unordered = run_unordered(
        scene.picture, tokens, label="frames", places=Places(reads=dataset.places), **options
    )
    with closing(in_order(unordered)) as pictures:
        write_video(target, pictures, fps=fps)
    return target


def _numbers(frames: Collection[int] | slice | None, last_frame: int) -> list[int]:
    """Return frame numbers from 1; raises ChoiceError."""
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
    """Return how many processes render a caller's functions.

    Raises:
        ChoiceError: A function cannot be sent to them.
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
