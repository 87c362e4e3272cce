"""Videos: what is in the file is what the views draw, in order; and nothing half-written."""

import logging
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgba
from PIL import Image, ImageSequence
from video_views import STEP, colors, grey

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.accident import draw_countdown
from deepaccident_devkit.render.camera import render_sample_data
from deepaccident_devkit.render.colors import COLLIDER_COLOR, COMPANION_COLOR
from deepaccident_devkit.render.video import VIEWS, render_scenario_video
from deepaccident_devkit.render.video.views import Scene, names_at, views_of
from deepaccident_devkit.render.video.writers import write_video
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS
from deepaccident_devkit.v2x import collision

SIZE = (160, 90)


@pytest.fixture(scope="module")
def accident(da: DeepAccident) -> str:
    return next(record["token"] for record in da.scenario if record["collision"])


@pytest.fixture
def video(da: DeepAccident, accident: str, tmp_path: Path) -> Callable[..., Path]:
    """Write a small video; `name` is the file's."""

    def write(name: str, **options: Any) -> Path:
        return render_scenario_video(
            da, accident, tmp_path / name, **{"what": grey, "size": SIZE, "progress": False, **options}
        )

    return write


def decoded(path: Path) -> list[Any]:
    """Its pictures (H, W, 3)."""
    if path.suffix == ".mp4":
        av = pytest.importorskip("av")
        with av.open(str(path)) as container:
            return [frame.to_ndarray(format="rgb24").astype(float) for frame in container.decode(video=0)]
    with Image.open(path) as image:
        return [np.asarray(each.convert("RGB"), dtype=float) for each in ImageSequence.Iterator(image)]


def greys(path: Path) -> list[int]:
    """The frame numbers that the pictures of `grey` tell."""
    pictures = decoded(path)
    assert all(np.ptp(picture) < 12 for picture in pictures)
    return [round(float(picture.mean()) / STEP) for picture in pictures]


@pytest.mark.parametrize("suffix", [".mp4", ".gif", ".webp"])
def test_a_video_has_all_frames_in_order_at_its_size(video: Callable[..., Path], suffix: str) -> None:
    path = video(f"v{suffix}")
    assert greys(path) == [1, 2, 3, 4, 5, 6]
    assert all(picture.shape == (SIZE[1], SIZE[0], 3) for picture in decoded(path))
    assert [each.name for each in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", [".mp4", ".gif", ".webp"])
def test_colors_are_right_in_the_file(video: Callable[..., Path], suffix: str) -> None:
    picture = decoded(video(f"v{suffix}", what=colors, frames=[1]))[0]
    np.testing.assert_allclose(picture[45, 40], (255, 0, 0), atol=20)
    np.testing.assert_allclose(picture[45, 120], (0, 0, 255), atol=20)


def test_few_pixels_keep_their_color_in_a_gif(tmp_path: Path) -> None:
    """A box is some pixels of a picture of thousands of other colours."""
    rng = np.random.default_rng(0)
    photo = rng.integers(60, 140, (90, 160, 3), dtype=np.uint8)
    marks = {(10, 20): COLLIDER_COLOR, (50, 60): COMPANION_COLOR}
    for (row, column), color in marks.items():
        photo[row : row + 2, column : column + 12] = np.array(to_rgba(color)[:3]) * 255
    write_video(tmp_path / "v.gif", [photo, photo[::-1]], fps=10)
    (first, _) = decoded(tmp_path / "v.gif")
    for (row, column), color in marks.items():
        np.testing.assert_allclose(first[row, column + 5], np.array(to_rgba(color)[:3]) * 255, atol=25)


def test_mp4_is_what_browsers_play(video: Callable[..., Path]) -> None:
    av = pytest.importorskip("av")
    path = video("v.mp4", fps=5)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert (float(stream.average_rate), stream.frames) == (5.0, 6)
    content = path.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat"), "the index is in front, so that it plays while it loads"


@pytest.mark.parametrize(("suffix", "duration"), [(".gif", 200), (".webp", 200)])
def test_animations_go_on_for_ever_at_the_rate_asked_for(
    video: Callable[..., Path], suffix: str, duration: int
) -> None:
    with Image.open(video(f"v{suffix}", fps=5)) as image:
        image.seek(2)
        image.load()
    assert (image.info["duration"], image.info["loop"]) == (duration, 0)


def test_two_workers_write_the_same_bytes_as_one(video: Callable[..., Path]) -> None:
    one, two = (video(f"{count}.mp4", what=[grey, "bev"], frames=slice(0, 3), workers=count) for count in (1, 2))
    assert one.read_bytes() == two.read_bytes()


def test_frames_are_numbers_in_any_order_or_a_slice_of_all(video: Callable[..., Path]) -> None:
    assert greys(video("a.gif", frames=range(5, 1, -2))) == [5, 3]
    assert greys(video("b.gif", frames=slice(-2, None))) == [5, 6]
    assert greys(video("c.gif", frames=slice(None, None, 5))) == [1, 6]


def test_views_side_by_side_have_their_shares_of_the_width(da: DeepAccident, accident: str) -> None:
    frame = f"{accident}/004"
    views = views_of(["bev", "frame", grey], None)
    picture = Scene(dataset=da, views=views, agents=None, width=400, height=90).picture(frame)
    assert picture.shape == (90, 400, 3)
    assert VIEWS["frame"].share == 2
    assert (picture[:, 300:] == 4 * STEP).all()
    assert (picture[:, 299] != 4 * STEP).all()
    assert (picture[:, :100] != 255).any()


@pytest.mark.parametrize("name", sorted(set(VIEWS) - set(CAMERAS[1:])))
def test_every_view_draws(da: DeepAccident, accident: str, name: str) -> None:
    scene = Scene(dataset=da, views=views_of(name, None), agents=None, width=320, height=180)
    picture = scene.picture(f"{accident}/003")
    assert picture.shape == (180, 320, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50
    assert not plt.get_fignums()


def test_a_camera_is_the_one_of_the_first_agent_named(da: DeepAccident, accident: str) -> None:
    frame, names = f"{accident}/003", ["other_vehicle", "ego_vehicle"]
    assert names_at(da, frame, names) == ("other_vehicle", "ego_vehicle")
    assert names_at(da, frame, None) == AGENTS
    assert names_at(da, frame, "+other") == ("ego_vehicle", "other_vehicle")
    scene = Scene(dataset=da, views=views_of("Camera_Back", None), agents=names, width=320, height=180)

    def draw(dataset: Any, record: Any, fig: Any) -> None:
        render_sample_data(dataset, f"{accident}/other_vehicle/003/Camera_Back", ax=fig.add_subplot())

    own = Scene(dataset=da, views=views_of(draw, None), agents=None, width=320, height=180)
    np.testing.assert_array_equal(scene.picture(frame), own.picture(frame))


def test_each_view_draws_those_of_the_layers_that_it_has() -> None:
    chosen = [layers for _, layers in views_of(["Camera_Front", "bev", "visibility_matrix"], ["image", "boxes"])]
    assert chosen == [("image", "boxes"), ("boxes",), ()]
    assert [layers for _, layers in views_of(["Camera_Front", "bev"], None)] == [None, None]


def test_the_countdown_has_five_cameras_and_the_pair_at_its_place(da: DeepAccident, accident: str) -> None:
    fig = detached_figure((12.8, 7.2))
    draw_countdown(da, f"{accident}/004", AGENTS, None, fig)
    agents = [ax.get_title().split(":")[0] for ax in fig.axes if "Camera_" in ax.get_title()]
    assert agents == ["ego", "ego behind", "other", "other behind", "infrastructure"]
    assert fig.get_suptitle() == "0.2 s to the impact"
    above = next(ax for ax in fig.axes if ax.get_title().startswith("from above"))
    contact = collision(da, accident)
    assert contact is not None
    tracks = [da.track.get(f"{accident}/004/actor/{actor}") for actor in contact.actor_ids]
    (boxes,) = [each for each in above.collections if isinstance(each, PolyCollection)][-1:]
    red = [np.allclose(color[:3], to_rgba(COLLIDER_COLOR)[:3]) for color in boxes.get_edgecolor()]
    places = [path.vertices[:4].mean(axis=0) for path, is_red in zip(boxes.get_paths(), red, strict=True) if is_red]
    wanted = sorted(tuple(track["translation"][:2]) for track in tracks)
    np.testing.assert_allclose(sorted(map(tuple, places)), wanted, atol=0.05)


def test_an_agent_that_is_not_asked_for_has_an_empty_place(da: DeepAccident, accident: str) -> None:
    fig = detached_figure((12.8, 7.2))
    draw_countdown(da, f"{accident}/006", ["infrastructure"], ["boxes"], fig)
    assert sum(ax.axison for ax in fig.axes) == 3  # a camera, from above, speeds
    assert not any(ax.images for ax in fig.axes)
    assert fig.get_suptitle() == "the impact"


def test_nothing_to_count_down_to_is_said(da: DeepAccident, tmp_path: Path) -> None:
    normal = next(record["token"] for record in da.scenario if not record["collision"])
    with pytest.raises(NotAvailableError, match=r"nobody collides in it.*the view 'frame'"):
        render_scenario_video(da, normal, tmp_path / "v.gif", what="accident", workers=1, progress=False)
    assert not list(tmp_path.iterdir())


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
        video(f"v{suffix}", what=breaks)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(f"v{suffix}", "old")]


def test_without_av_opencv_writes_mp4_and_says_who_does_not_play_it(
    video: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    import cv2

    monkeypatch.setitem(sys.modules, "av", None)
    with caplog.at_level(logging.WARNING):
        path = video("v.mp4", what=colors)
    assert "browsers do not play; for H.264: pip install 'deepaccident_devkit[video]'" in caplog.text
    assert [each.name for each in path.parent.iterdir()] == ["v.mp4"]
    capture = cv2.VideoCapture(str(path))
    pictures = []
    while (read := capture.read())[0]:
        pictures.append(read[1][..., ::-1])
    assert len(pictures) == 6
    np.testing.assert_allclose(pictures[5][45, 40], (255, 0, 0), atol=25)
    np.testing.assert_allclose(pictures[5][45, 120], (0, 0, 255), atol=25)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"name": "v.avi"}, r"path: expected a file that ends in \.mp4, \.gif, \.webp, found '.*v\.avi'"),
        ({"size": (161, 90)}, "size: expected an even width and height, which MP4 needs"),
        ({"size": (0, 90)}, "size: expected width and height of at least 16 pixels"),
        ({"fps": 0}, "fps: expected frames a second, above 0"),
        ({"what": "film"}, "what: expected frame, sample, accident, .* or a function, found 'film'"),
        ({"what": []}, "what: expected at least one of frame, "),
        ({"what": "bev", "layers": ["image"]}, "layers: expected any of .*bev.*, found 'image'"),
        ({"frames": [1, 7]}, "frames: expected numbers from 1 to 6, found 7"),
        ({"frames": slice(9, None)}, "frames: expected numbers from 1 to 6, found none"),
        ({"agents": ["pole"]}, "agent: expected one of ego_vehicle.*'pole'"),
        ({"what": lambda *_: None, "workers": 2}, "cannot be sent to other processes; put it into a module"),
    ],
)
def test_errors_come_before_anything_is_drawn(
    video: Callable[..., Path], tmp_path: Path, options: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ChoiceError, match=sentence):
        video(**{"name": "v.mp4", **options})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("what", [("frame", "visibility", "bev"), ("frame", "sample", "labels")])
def test_words_keep_their_room_beside_other_views(da: DeepAccident, accident: str, what: tuple[str, ...]) -> None:
    """Nothing is written over a view's left or right edge; matplotlib warns, which is an error here, if it gives up."""
    scene = Scene(dataset=da, views=views_of(what, None), agents=None, width=1280, height=720)
    picture, total = scene.picture(f"{accident}/002").astype(int), sum(VIEWS[name].share for name in what)
    edges = np.cumsum([0, *(VIEWS[name].share for name in what)]) * 1280 // total
    for left, right in pairwise(edges.tolist()):
        assert (picture[:, [left, right - 1]] > 250).all()


def test_a_folder_is_no_video(da: DeepAccident, accident: str, tmp_path: Path) -> None:
    (tmp_path / "a.gif").mkdir()
    with pytest.raises(ChoiceError, match="path: expected a file, found the folder"):
        render_scenario_video(da, accident, tmp_path / "a.gif")
