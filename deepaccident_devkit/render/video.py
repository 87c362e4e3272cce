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
# Colours of a GIF; one more is kept for pixels that do not change.
_COLORS: Final = 255
# About so many pixels of all pictures are used to choose the palette.
_LOOKED_AT: Final = 2_000_000
# Renders a moment, given by its record, on an empty figure; its result is not used.
OwnView = Callable[[Dataset, "FrameRecord", "Figure"], object]
_DPI: Final = 100.0
# Pixels that stay free beside a view.
_EDGE: Final = 5
# A picture with so many pixels has `_DPI` pixels an inch; larger ones have more, so words keep their share.
_DPI_AT: Final = 1280 * 720


def check_target(path: Path, *, size: tuple[int, int], fps: float) -> None:
    """Check before anything is rendered that the file can be written; raises ChoiceError and MissingExtraError."""
    if path.suffix.lower() not in SUFFIXES:
        raise ChoiceError(
            f"path: expected a file that ends in {', '.join(SUFFIXES)}, found {str(path)!r}"
        )
    if path.is_dir():
        raise ChoiceError(f"path: expected a file, found the folder {path}")
    folder = next(each for each in path.absolute().parents if each.exists())
    if not os.access(folder, os.W_OK):
        raise ChoiceError(f"path: nothing can be written into {folder}; choose another folder")
    if not 0 < fps <= 100:
        raise ChoiceError(f"fps: expected frames a second, above 0 and at most 100, found {fps!r}")
    if min(size) < 16:
        raise ChoiceError(f"size: expected width and height of at least 16 pixels, found {size}")
    if path.suffix.lower() == ".mp4":
        if any(side % 2 for side in size):
            even = tuple(side - side % 2 for side in size)
            raise ChoiceError(
                f"size: expected an even width and height, which MP4 needs, found {size}; give {even}"
            )
        try:
            import av  # noqa: F401 - whether it is installed
        except ImportError:
            raise MissingExtraError(
                f"{path}: MP4 needs PyAV: in a checkout, pip install '.[video]'; or choose .gif or .webp"
            ) from None


def write_video(path: Path, pictures: Iterable[ByteArray], *, fps: float) -> None:
    """Write pictures, (H, W, 3) uint8 RGB of one size, as the video that the path's suffix says, atomically.

    H and W are even for MP4; there is at least one picture.
    """
    with replacing(path) as temporary:
        SUFFIXES[path.suffix.lower()](temporary, pictures, fps)


def _write_mp4(path: Path, pictures: Iterable[ByteArray], fps: float) -> None:
    """H.264 in yuv420p with its index in front: browsers play it, and begin before it is complete."""
    import av

    with av.open(
        os.fspath(path), "w", format="mp4", options={"movflags": "+faststart"}
    ) as container:
        stream = None
        for picture in pictures:
            if stream is None:
                stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"
                # in a virtual machine, x264's code for AVX-512 made other bytes in 2 of 100 files of the same pictures
                stream.options = {"crf": _CRF, "x264-params": "asm=sse4.2"}
                stream.codec_context.thread_count = 1  # the bytes depend on the number of threads
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        if stream is not None:
            container.mux(stream.encode(None))


def _write_gif(path: Path, pictures: Iterable[ByteArray], fps: float) -> None:
    """One palette for all pictures, without dithering: pixels that stay the same are stored once and do not flicker."""
    import numpy as np
    from PIL import Image

    drawn = list(pictures)
    every = max(1, round((sum(picture.size / 3 for picture in drawn) / _LOOKED_AT) ** 0.5))
    looked_at = np.concatenate([picture[::every, ::every].reshape(-1, 3) for picture in drawn])
    palette = Image.fromarray(looked_at[None]).quantize(_COLORS, Image.Quantize.MAXCOVERAGE)
    images = [Image.fromarray(picture) for picture in drawn]
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    _save_animation(path, images, fps, format="GIF", optimize=True)


def _write_webp(path: Path, pictures: Iterable[ByteArray], fps: float) -> None:
    from PIL import Image

    images = [Image.fromarray(picture) for picture in pictures]
    _save_animation(path, images, fps, format="WEBP", quality=_WEBP_QUALITY, method=4)


def _save_animation(path: Path, images: Sequence[Image], fps: float, **how: Any) -> None:
    """Write pillow's images as an animation that repeats forever."""
    first, *others = images
    first.save(path, save_all=True, append_images=others, duration=round(1000 / fps), loop=0, **how)


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
        draw: renders the row of a token of a release, as the functions of this package do.
        of: whose token it takes: of the moment's `frame`, or of the first agent's `sample`.
        canvas: `fig` if it renders on an empty figure, `ax` if on axes.
        takes: what it takes of the video's choices.
        layers: the layers that it has.
        share: of a picture's width, if there are several views.
        inches: width that it needs for its words; if there is less, they become smaller.
        own: whether it is a caller's function, which takes release, frame record and figure.
    """

    draw: Callable[..., object]
    of: Literal["frame", "sample"] = "sample"
    canvas: Literal["fig", "ax"] = "fig"
    takes: tuple[str, ...] = ("agents", "layers")
    layers: tuple[Layer, ...] = LAYERS
    share: int = 1
    inches: float = 4.2
    own: bool = False

    def on(
        self,
        fig: Figure,
        dataset: Dataset,
        frame: str,
        agents: Sequence[str],
        layers: tuple[Layer, ...] | None,
    ) -> None:
        """Render a moment, by its frame's token, on an empty figure.

        Args:
            fig: the figure.
            dataset: the release.
            frame: token.
            agents: names; the first one is the agent whose view it is.
            layers: None for the view's default.
        """
        if self.own:
            self.draw(dataset, dataset.frame[dataset.getind("frame", frame)], fig)
            return
        scenario, number = frame.rsplit("/", 1)
        token = frame if self.of == "frame" else sample_token(scenario, agents[0], int(number))
        chosen = {"agents": agents, "layers": layers}
        canvas = fig if self.canvas == "fig" else fig.add_subplot()
        self.draw(
            dataset, token, **{self.canvas: canvas}, **{name: chosen[name] for name in self.takes}
        )


def _draw_channel(
    channel: str, dataset: Dataset, sample: str, *, layers: tuple[Layer, ...] | None, ax: Axes
) -> None:
    shown = CAMERA_DEFAULT if layers is None else layers
    draw_camera(dataset, dataset.get("sample_data", f"{sample}/{channel}"), shown, ax)


# The views by name; cameras are those of the first agent.
VIEWS: Final[Mapping[str, _View]] = {
    "frame": _View(draw=draw_shared_moment, of="frame", layers=MOMENT_LAYERS, share=2, inches=12.8),
    "sample": _View(draw=render_sample, layers=MOMENT_LAYERS, share=2, inches=12.8),
    "accident": _View(draw=draw_countdown, of="frame", layers=PAIR_LAYERS, share=2, inches=12.8),
    "bev": _View(draw=render_bev, canvas="ax", layers=BEV_LAYERS, inches=4.6),
    "visibility": _View(draw=render_visibility, canvas="ax", layers=VISIBILITY_LAYERS),
    "visibility_matrix": _View(
        draw=render_visibility_matrix, canvas="ax", takes=("agents",), layers=()
    ),
    "calibration": _View(
        draw=render_calibration, of="frame", layers=CALIBRATION_LAYERS, share=2, inches=12.0
    ),
    "labels": _View(
        draw=partial(render_motion_labels, style="trail"),
        takes=("layers",),
        layers=TRAIL_LAYERS,
        inches=5.5,
    ),
    **{
        channel: _View(
            draw=partial(_draw_channel, channel),
            canvas="ax",
            takes=("layers",),
            layers=CAMERA_LAYERS,
        )
        for channel in CAMERAS
    },
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VideoScene:
    """How every frame of a video is rendered.

    Attributes:
        dataset: the release.
        views: side by side, each with the layers that it renders.
        agents: as in `cooperating_agents`.
        width: pixels.
        height: pixels.
    """

    dataset: Dataset
    views: tuple[tuple[_View, tuple[Layer, ...] | None], ...]
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
            parts.append(self._drawn(view, right - left, frame, names, layers))
            left = right
        return np.hstack(parts)

    @in_own_settings
    def _drawn(
        self,
        view: _View,
        width: int,
        frame: str,
        agents: Sequence[str],
        layers: tuple[Layer, ...] | None,
    ) -> ByteArray:
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        dpi = min(_DPI * (self.width * self.height / _DPI_AT) ** 0.5, width / view.inches)
        fig: Any = figure_of_pixels(width, self.height, dpi=dpi)
        fig.get_layout_engine().set(w_pad=_EDGE / dpi)
        view.on(fig, self.dataset, frame, agents, layers)
        canvas: Any = FigureCanvasAgg(fig)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def names_at(dataset: Dataset, frame: str, agents: Agents) -> tuple[str, ...]:
    """The chosen agents at a frame; first is the one whose view it is: the first one named, or the first one there."""
    names = cooperating_agents(dataset, dataset.samples_of(frame)[0], agents)
    checked = checked_agents(agents)
    first = checked[0] if isinstance(checked, tuple) else names[0]
    return tuple(sorted(names, key=first.__ne__))


def views_of(
    what: str | OwnView | Iterable[str | OwnView], layers: Iterable[Layer] | None
) -> tuple[tuple[_View, tuple[Layer, ...] | None], ...]:
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


def _view(given: object) -> _View:
    return (
        _View(draw=given, layers=(), own=True)
        if callable(given)
        else VIEWS[choice("what", given, VIEWS)]
    )


def render_scenario_video(  # noqa: PLR0913 - each is a choice that stands on its own in a notebook
    dataset: Dataset,
    scenario: RowArgument,
    path: str | os.PathLike[str],
    *,
    what: str | OwnView | Iterable[str | OwnView] = "frame",
    agents: Agents = None,
    layers: Iterable[Layer] | None = None,
    frames: Collection[int] | slice | None = None,
    size: tuple[int, int] = (1280, 720),
    fps: float = 10.0,
    **how: Unpack[Engine],
) -> Path:
    """Write a scenario as a video.

    The views are those of the `render_…` functions: `frame` (the agents' front cameras beside one view from above),
    `sample` (six cameras), `bev`, `visibility`, `visibility_matrix`, `calibration`, `labels` (motion labels as a
    trail), a camera by its channel, and `accident`: the countdown to the impact in five cameras, from above and in
    speeds. `frame`, `accident`, or two or three of the others side by side, fill a picture of 16 to 9.

    Args:
        dataset: the release.
        scenario: token or record.
        path: the file to write, by its suffix: `.mp4` (with the extra `video`), `.gif` or `.webp`. An earlier file is
            replaced when the new one is complete.
        what: a view by name, a function (dataset, frame record, figure) that renders one, or several side by side.
        agents: who is shown, or None for all that are there. Views of one agent (`sample`, `bev`, cameras, …) show the
            first one named, or the first one there; their boxes and points from above are of all of `agents`.
        layers: each view renders those of them that it has; None for the default of each view.
        frames: numbers of frames, from 1, in the order given; or a slice of the list of all frames; None for all.
        size: (width, height), pixels; even numbers for MP4. `load_image` counts as arrays do: (height, width).
        fps: frames a second; the recordings have 10.
        **how: as of `parallel.Engine`, with a bar unless `progress` says otherwise. By default this process alone calls
            functions of your own; others can do so if these are importable from a module.

    Returns:
        The path written.

    Raises:
        TokenError: no such scenario.
        ChoiceError: no such view, layer, agent, frame or kind of file, or the file cannot have this size or rate.
        NotAvailableError: an agent is not in this release, the sample has no label, or nobody collides and the view
            is `accident`.
        MissingExtraError: the file is an `.mp4`, and the extra `video` is not installed.
        WorkerError: as `parallel.Engine` says.
    """
    target, (width, height) = path_of(path), size
    check_target(target, size=(width, height), fps=fps)
    views = views_of(what, layers)
    record = dataset.get("scenario", scenario)
    tokens = [
        frame_token(record["token"], number) for number in _numbers(frames, record["num_frames"])
    ]
    names_at(dataset, tokens[0], agents)  # before any worker starts
    own = [view.draw for view, _ in views if view.own]
    scene = VideoScene(dataset=dataset, views=views, agents=agents, width=width, height=height)
    engine: Engine = {"progress": True, **how, "workers": _workers(own, how.get("workers"))}
    drawn = run_unordered(
        scene.picture, tokens, label="frames", places=Places(reads=dataset.places), **engine
    )
    with closing(in_order(drawn)) as pictures:
        write_video(target, pictures, fps=fps)
    return target


def _numbers(frames: Collection[int] | slice | None, last: int) -> list[int]:
    """Frame numbers from 1; raises ChoiceError."""
    recorded = range(1, last + 1)
    if frames is None or isinstance(frames, slice):
        numbers = list(recorded[frames] if frames else recorded)
    else:
        numbers = list(frames)
    wrong = [number for number in numbers if number not in recorded]
    if wrong or not numbers:
        raise ChoiceError(
            f"frames: expected numbers from 1 to {last}, found {wrong[0] if wrong else 'none'}"
        )
    return numbers


def _workers(own: Sequence[Callable[..., object]], workers: int | None) -> int | None:
    """How many processes render; raises ChoiceError if a function cannot be sent to them."""
    if not own or workers == 1:
        return workers
    if workers is None:
        return 1
    for function in own:
        name = getattr(function, "__qualname__", "<")
        if function.__module__ == "__main__" or "<" in name:
            raise ChoiceError(
                f"workers: {name} cannot be sent to other processes; put it into a module of its own, or pass workers=1"
            )
    return workers
