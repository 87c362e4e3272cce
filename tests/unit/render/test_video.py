"""Videos: what is in the file is what the views draw, in order; and nothing half-written."""

import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib.colors import to_rgba
from PIL import Image
from refusals import assert_refused
from video_views import SIZE, STEP, colors, decoded, grey, greys

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, MissingExtraError
from deepaccident_devkit.render.camera import CAMERA_DEFAULT, draw_camera
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR
from deepaccident_devkit.render.video import (
    VIEWS,
    VideoScene,
    render_scenario_video,
    views_of,
    write_video,
)
from deepaccident_devkit.taxonomy import CAMERAS


@pytest.mark.slow
def test_two_workers_and_an_executor_write_the_same_bytes_as_one(
    video: Callable[..., Path],
) -> None:
    how = {"views": [grey, "bev"], "frames": slice(0, 3)}
    one, two = (video(f"{count}.mp4", workers=count, **how) for count in (1, 2))
    with ThreadPoolExecutor(3) as executor:
        sent = video("sent.mp4", executor=executor, **how)
    assert one.read_bytes() == two.read_bytes() == sent.read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".mp4", ".gif", ".webp"])
def test_a_video_has_all_frames_in_order_at_its_size(
    video: Callable[..., Path], suffix: str
) -> None:
    path = video(f"v{suffix}")
    assert greys(path) == [1, 2, 3, 4, 5, 6]
    assert {picture.shape for picture in decoded(path)} == {(SIZE[1], SIZE[0], 3)}
    assert [each.name for each in path.parent.iterdir()] == [path.name]


@pytest.mark.slow
def test_frames_are_numbers_in_any_order_or_a_slice_of_all(video: Callable[..., Path]) -> None:
    for frames, shown in (
        (range(5, 1, -2), [5, 3]),
        (slice(-2, None), [5, 6]),
        (slice(None, None, 5), [1, 6]),
    ):
        assert greys(video("a.gif", frames=frames)) == shown


@pytest.mark.slow
@pytest.mark.parametrize("stop", [ValueError("broken"), KeyboardInterrupt()])
@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_what_is_interrupted_leaves_the_old_file_alone(
    video: Callable[..., Path], tmp_path: Path, suffix: str, stop: BaseException
) -> None:
    def breaks(dataset: Any, frame: Any, fig: Any) -> None:
        if frame["index"] == 3:
            raise stop

    (tmp_path / f"v{suffix}").write_text("old")
    with pytest.raises(type(stop)):
        video(f"v{suffix}", views=breaks)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(f"v{suffix}", "old")]


def test_errors_come_before_anything_is_drawn(video: Callable[..., Path], tmp_path: Path) -> None:
    def write(name: str = "v.mp4", **options: Any) -> Callable[[], object]:
        return lambda: video(name, **options)

    assert_refused(
        (write("v.avi"), ChoiceError, ("path", ".mp4, .gif, .webp", "v.avi")),
        (
            write(size=(161, 90)),
            ChoiceError,
            ("size", "even width and height", "MP4", "give (160, 90)"),
        ),
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
    assert_refused((write("a.gif"), ChoiceError, ("path", "the folder")))


@pytest.fixture(scope="session")
def accident(da: DeepAccident) -> str:
    return next(record["token"] for record in da.scenario if record["collision"])


@pytest.fixture
def video(da: DeepAccident, accident: str, tmp_path: Path) -> Callable[..., Path]:
    """Write a small video; `name` is the file's."""

    def write(name: str, **options: Any) -> Path:
        return render_scenario_video(
            da,
            accident,
            tmp_path / name,
            **{"views": grey, "size": SIZE, "progress": False, **options},
        )

    return write


def picture_of(
    da: DeepAccident, frame: str, what: Any, size: tuple[int, int], agents: Any = None
) -> Any:
    """A frame of a video."""
    scene = VideoScene(
        dataset=da, views=views_of(what, None), agents=agents, width=size[0], height=size[1]
    )
    return scene.picture(frame)


@pytest.mark.slow
def test_views_side_by_side_have_their_shares_of_the_width(da: DeepAccident, accident: str) -> None:
    picture = picture_of(da, f"{accident}/004", ["bev", "frame", grey], (400, 90))
    assert (picture.shape, VIEWS["frame"].share) == ((90, 400, 3), 2)
    assert (picture[:, 300:] == 4 * STEP).all()
    assert (picture[:, 299] != 4 * STEP).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(VIEWS) - set(CAMERAS[1:])))
def test_every_view_draws(da: DeepAccident, accident: str, name: str) -> None:
    picture = picture_of(da, f"{accident}/003", name, (320, 180))
    assert picture.shape == (180, 320, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50
    assert not plt.get_fignums()


def test_a_camera_is_the_one_of_the_first_agent_named(da: DeepAccident, accident: str) -> None:
    frame, names = f"{accident}/003", ["other_vehicle", "ego_vehicle"]

    def draw(dataset: Any, record: Any, fig: Any) -> None:
        camera = dataset.get("sample_data", f"{accident}/other_vehicle/003/Camera_Back")
        draw_camera(dataset, camera, CAMERA_DEFAULT, fig.add_subplot())

    shown, own = (picture_of(da, frame, what, (320, 180), names) for what in ("Camera_Back", draw))
    np.testing.assert_array_equal(shown, own)


def test_each_view_draws_those_of_the_layers_that_it_has() -> None:
    chosen = [
        layers
        for _, layers in views_of(["Camera_Front", "bev", "visibility_matrix"], ["image", "boxes"])
    ]
    assert chosen == [("image", "boxes"), ("boxes",), ()]
    assert [layers for _, layers in views_of(["Camera_Front", "bev"], None)] == [None, None]


@pytest.mark.parametrize("suffix", [".mp4", ".gif", ".webp"])
def test_colors_are_right_in_the_file(video: Callable[..., Path], suffix: str) -> None:
    picture = decoded(video(f"v{suffix}", views=colors, frames=[1]))[0]
    np.testing.assert_allclose(picture[45, 40], (255, 0, 0), atol=20)
    np.testing.assert_allclose(picture[45, 120], (0, 0, 255), atol=20)


def test_few_pixels_keep_their_color_in_a_gif(tmp_path: Path) -> None:
    """A box is some pixels of a picture of thousands of other colours."""
    photo = np.random.default_rng(0).integers(60, 140, (90, 160, 3), dtype=np.uint8)
    marks = {(10, 20): COLLIDER_COLOR, (50, 60): AGENT_COLORS["ego_vehicle"]}
    for (row, column), color in marks.items():
        photo[row : row + 2, column : column + 12] = np.array(to_rgba(color)[:3]) * 255
    write_video(tmp_path / "v.gif", [photo, photo[::-1]], fps=10)
    (first, _) = decoded(tmp_path / "v.gif")
    for (row, column), color in marks.items():
        np.testing.assert_allclose(
            first[row, column + 5], np.array(to_rgba(color)[:3]) * 255, atol=25
        )


def test_mp4_is_what_browsers_play(video: Callable[..., Path]) -> None:
    av = pytest.importorskip("av")
    path = video("v.mp4", fps=5)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert (float(stream.average_rate), stream.frames) == (5.0, 6)
    content = path.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat"), (
        "the index is in front, so that it plays while it loads"
    )


@pytest.mark.parametrize(("suffix", "duration"), [(".gif", 200), (".webp", 200)])
def test_animations_go_on_for_ever_at_the_rate_asked_for(
    video: Callable[..., Path], suffix: str, duration: int
) -> None:
    with Image.open(video(f"v{suffix}", fps=5)) as image:
        image.seek(2)
        image.load()
    assert (image.info["duration"], image.info["loop"]) == (duration, 0)


@pytest.mark.parametrize("name", ["v.mp4", "v.MP4"])
def test_without_av_mp4_is_refused_before_anything_is_drawn(
    video: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    told = ("MP4 needs PyAV", "[video]", ".gif or .webp")
    assert_refused(
        (lambda: video(name, views=lambda *_: pytest.fail("drawn")), MissingExtraError, told)
    )
    assert not list(tmp_path.iterdir())
