"""Videos contain what the views draw, in order, and are never left half-written."""

import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib.colors import to_rgb
from PIL import Image
from support.expected_errors import assert_raises
from support.figure_texts import find_text_faults
from support.replay_page import accident_scenario
from support.video_views import (
    GREY_STEP,
    IMAGE_SIZE,
    decode_video,
    draw_colors,
    draw_grey,
    grey_frame_numbers,
)

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, MissingExtraError
from deepaccident_devkit.render import style, video
from deepaccident_devkit.render.camera import CAMERA_DEFAULT, draw_camera
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR
from deepaccident_devkit.render.video import (
    VIEWS,
    VideoScene,
    render_scenario_video,
    views_of,
    write_video,
)
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS


@pytest.mark.slow
def test_two_workers_and_an_executor_write_the_same_bytes_as_one(
    write_video_file: Callable[..., Path],
) -> None:
    options = {"views": [draw_grey, "bev"], "frames": slice(0, 3)}
    single, double = (
        write_video_file(f"{count}.mp4", workers=count, **options) for count in (1, 2)
    )
    with ThreadPoolExecutor(3) as executor:
        executed = write_video_file("sent.mp4", executor=executor, **options)

    assert single.read_bytes() == double.read_bytes() == executed.read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".mp4", ".gif", ".webp"])
def test_a_video_has_all_frames_in_order_at_its_size(
    write_video_file: Callable[..., Path], suffix: str
) -> None:
    path = write_video_file(f"v{suffix}")
    assert grey_frame_numbers(path) == [1, 2, 3, 4, 5, 6]
    width, height = IMAGE_SIZE
    assert {picture.shape for picture in decode_video(path)} == {(height, width, 3)}
    assert [file.name for file in path.parent.iterdir()] == [path.name]


@pytest.mark.slow
def test_frames_are_numbers_in_any_order_or_a_slice_of_all(
    write_video_file: Callable[..., Path],
) -> None:
    for frames, numbers in (
        (range(5, 1, -2), [5, 3]),
        (slice(-2, None), [5, 6]),
        (slice(None, None, 5), [1, 6]),
    ):
        path = write_video_file("a.gif", frames=frames)
        assert grey_frame_numbers(path) == numbers


@pytest.mark.slow
@pytest.mark.parametrize("stop", [ValueError("broken"), KeyboardInterrupt()])
@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_an_interrupted_video_leaves_the_old_file_as_it_was(
    write_video_file: Callable[..., Path], tmp_path: Path, suffix: str, stop: BaseException
) -> None:
    def break_at_third_frame(dataset: Any, frame: Any, fig: Any) -> None:
        if frame["index"] == 3:
            raise stop

    name = f"v{suffix}"
    (tmp_path / name).write_text("old")
    with pytest.raises(type(stop)):
        write_video_file(name, views=break_at_third_frame)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "old")]


def test_an_odd_size_is_rounded_down_to_an_even_one(
    write_video_file: Callable[..., Path],
) -> None:
    for name, size, expected in (("v.mp4", (161, 91), (160, 90)), ("v.gif", (161, 91), (161, 91))):
        path = write_video_file(name, size=size, frames=[1])
        assert decode_video(path)[0].shape[1::-1] == expected


def test_a_single_camera_without_other_layers_fills_the_picture(
    da: DeepAccident, accident: str
) -> None:
    image = da.load_image(f"{accident}/ego_vehicle/003/Camera_Front")
    height, width, _ = image.shape
    for scale in (1, 2):
        scene = VideoScene(
            dataset=da,
            views=views_of("Camera_Front", ["image"]),
            agents=None,
            width=width * scale,
            height=height * scale,
        )
        picture = scene.picture(f"{accident}/003")
        shrunk = picture.reshape(height, scale, width, scale, 3).mean(axis=(1, 3))
        np.testing.assert_allclose(shrunk, image, atol=0 if scale == 1 else 40)


@pytest.mark.slow
def test_a_video_keeps_its_style_in_workers(write_video_file: Callable[..., Path]) -> None:
    options = {"views": "bev", "frames": [2, 3], "size": (320, 180)}
    with style(title=False):
        single, double = (
            write_video_file(f"{count}.gif", workers=count, **options) for count in (1, 2)
        )
    titled = write_video_file("titled.gif", workers=1, **options)
    assert single.read_bytes() == double.read_bytes() != titled.read_bytes()


def test_views_of_one_agent_show_by_default_the_one_with_most_files(
    da_partial: DeepAccident, tmp_path: Path
) -> None:
    shown_samples = []

    def draw(dataset: Any, sample: str, **options: Any) -> None:
        shown_samples.append(sample)

    view = replace(VIEWS["Camera_Front"], draw=draw)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(video, "VIEWS", {**VIEWS, "Camera_Front": view})
        for agents in (None, ["ego_vehicle"]):
            render_scenario_video(
                da_partial,
                accident_scenario(da_partial),
                tmp_path / "v.gif",
                views="Camera_Front",
                agents=agents,
                frames=[3],
                size=IMAGE_SIZE,
                workers=1,
                progress=False,
            )
    # the ego's front camera was not downloaded
    assert [sample.split("/")[2] for sample in shown_samples] == [AGENTS[1], "ego_vehicle"]


FRAME_VIEWS: list[Any] = [
    "frame",
    "sample",
    "accident",
    "calibration",
    "labels",
    "visibility",
    "visibility_matrix",
    ["Camera_Front", "bev"],
    ["bev", "labels", "visibility"],
]


@pytest.mark.slow
@pytest.mark.parametrize("names", FRAME_VIEWS)
def test_texts_of_frames_are_in_the_picture_and_apart(
    da: DeepAccident, accident: str, names: Any
) -> None:
    views = views_of(names, None)
    scene = VideoScene(dataset=da, views=views, agents=None, width=1280, height=720)
    total_share = sum(view.share for view, _ in views)
    for view, layers in views:
        width = 1280 * view.share // total_share
        figure = scene.figure(view, width, f"{accident}/004", AGENTS, layers)
        assert find_text_faults(figure) == []


def test_errors_come_before_anything_is_drawn(
    write_video_file: Callable[..., Path], tmp_path: Path
) -> None:
    def write(name: str = "v.mp4", **options: Any) -> Callable[[], object]:
        return lambda: write_video_file(name, **options)

    assert_raises(
        (write("v.avi"), ChoiceError, ("v.avi: expected a file that ends in .mp4, .gif, .webp",)),
        (write(size=(0, 90)), ChoiceError, ("size", "at least 16 pixels")),
        (write(fps=0), ChoiceError, ("fps", "above 0")),
        (write(views="film"), ChoiceError, ("what", "frame, sample, accident", "'film'")),
        (write(views=[]), ChoiceError, ("what", "at least one of frame")),
        (write(views="bev", layers=["image"]), ChoiceError, ("layers", "bev", "'image'")),
        (write(frames=[1, 7]), ChoiceError, ("frames", "1 to 6", "found 7")),
        (write(frames=slice(9, None)), ChoiceError, ("frames", "1 to 6", "found none")),
        (write(agents=["pole"]), ChoiceError, ("agent", "ego_vehicle", "'pole'")),
        (
            write(views=lambda *_: None, workers=2),
            ChoiceError,
            ("cannot be sent to other processes", "a module"),
        ),
    )
    assert not list(tmp_path.iterdir())

    (tmp_path / "a.gif").mkdir()
    assert_raises((write("a.gif"), ChoiceError, ("a.gif: is a folder; give a file",)))


@pytest.fixture(scope="session")
def accident(da: DeepAccident) -> str:
    return accident_scenario(da)


@pytest.fixture
def write_video_file(da: DeepAccident, accident: str, tmp_path: Path) -> Callable[..., Path]:
    """A function that writes a small video of the accident under a file name."""

    def write(name: str, **options: Any) -> Path:
        options = {"views": draw_grey, "size": IMAGE_SIZE, "progress": False, **options}
        return render_scenario_video(da, accident, tmp_path / name, **options)

    return write


def draw_picture(
    da: DeepAccident, frame: str, views: Any, size: tuple[int, int], agents: Any = None
) -> Any:
    """Draw a frame of a video as an array (H, W, 3)."""
    width, height = size
    scene = VideoScene(
        dataset=da, views=views_of(views, None), agents=agents, width=width, height=height
    )
    return scene.picture(frame)


@pytest.mark.slow
def test_views_side_by_side_have_their_shares_of_the_width(da: DeepAccident, accident: str) -> None:
    picture = draw_picture(da, f"{accident}/004", ["bev", "frame", draw_grey], (400, 90))
    grey_level = 4 * GREY_STEP
    assert (picture.shape, VIEWS["frame"].share) == ((90, 400, 3), 2)
    assert (picture[:, 300:] == grey_level).all()
    assert (picture[:, 299] != grey_level).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(VIEWS) - set(CAMERAS[1:])))
def test_every_view_draws(da: DeepAccident, accident: str, name: str) -> None:
    picture = draw_picture(da, f"{accident}/003", name, (320, 180))
    assert picture.shape == (180, 320, 3)
    num_colors = len(np.unique(picture.reshape(-1, 3), axis=0))
    assert num_colors > 50
    assert not plt.get_fignums()


def test_a_camera_view_shows_the_first_agent_named(da: DeepAccident, accident: str) -> None:
    def draw(dataset: Any, frame: Any, fig: Any) -> None:
        camera = dataset.get("sample_data", f"{accident}/other_vehicle/003/Camera_Back")
        draw_camera(dataset, camera, CAMERA_DEFAULT, fig.add_subplot())

    agents = ["other_vehicle", "ego_vehicle"]
    picture, expected = (
        draw_picture(da, f"{accident}/003", view, (320, 180), agents)
        for view in ("Camera_Back", draw)
    )
    np.testing.assert_array_equal(picture, expected)


def test_each_view_draws_the_requested_layers_that_it_has() -> None:
    views = views_of(["Camera_Front", "bev", "visibility_matrix"], ["image", "boxes"])
    assert [layers for _, layers in views] == [("image", "boxes"), ("boxes",), ()]
    default_views = views_of(["Camera_Front", "bev"], None)
    assert [layers for _, layers in default_views] == [None, None]


@pytest.mark.parametrize("suffix", [".mp4", ".gif", ".webp"])
def test_colors_are_right_in_the_file(write_video_file: Callable[..., Path], suffix: str) -> None:
    path = write_video_file(f"v{suffix}", views=draw_colors, frames=[1])
    picture = decode_video(path)[0]
    np.testing.assert_allclose(picture[45, 40], (255, 0, 0), atol=20)
    np.testing.assert_allclose(picture[45, 120], (0, 0, 255), atol=20)


def test_few_pixels_keep_their_color_in_a_gif(tmp_path: Path) -> None:
    """A box has only a few pixels in a picture of thousands of other colours."""
    photo = np.random.default_rng(0).integers(60, 140, (90, 160, 3), dtype=np.uint8)
    marks = {
        (10, 20): np.array(to_rgb(COLLIDER_COLOR)) * 255,
        (50, 60): np.array(to_rgb(AGENT_COLORS["ego_vehicle"])) * 255,
    }
    for (row, column), color in marks.items():
        photo[row : row + 2, column : column + 12] = color

    write_video(tmp_path / "v.gif", [photo, photo[::-1]], fps=10)

    (first, _) = decode_video(tmp_path / "v.gif")
    for (row, column), color in marks.items():
        np.testing.assert_allclose(first[row, column + 5], color, atol=25)


def test_mp4_is_what_browsers_play(write_video_file: Callable[..., Path]) -> None:
    av = pytest.importorskip("av")
    path = write_video_file("v.mp4", fps=5)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        codec = stream.codec_context
        assert (codec.name, codec.pix_fmt) == ("h264", "yuv420p")
        assert (float(stream.average_rate), stream.frames) == (5.0, 6)

    content = path.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat"), (
        "the index is in front, so that it plays while it loads"
    )


@pytest.mark.parametrize(("suffix", "duration_ms"), [(".gif", 200), (".webp", 200)])
def test_animations_go_on_for_ever_at_the_rate_asked_for(
    write_video_file: Callable[..., Path], suffix: str, duration_ms: int
) -> None:
    with Image.open(write_video_file(f"v{suffix}", fps=5)) as animation:
        animation.seek(2)
        animation.load()
    assert (animation.info["duration"], animation.info["loop"]) == (duration_ms, 0)


@pytest.mark.parametrize("name", ["v.mp4", "v.MP4"])
def test_without_av_mp4_is_refused_before_anything_is_drawn(
    write_video_file: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    name: str,
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)

    assert_raises(
        (
            lambda: write_video_file(name, views=lambda *_: pytest.fail("drawn")),
            MissingExtraError,
            ("MP4 needs PyAV", "[video]", ".gif or .webp"),
        )
    )
    assert not list(tmp_path.iterdir())
