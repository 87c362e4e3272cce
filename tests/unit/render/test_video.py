"""Videos: what is in the file is what the views draw, in order; and nothing half-written."""

import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib.colors import to_rgba
from PIL import Image
from video_views import SIZE, STEP, colors, decoded, grey, greys

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, MissingExtraError
from deepaccident_devkit.render.camera import CAMERA_DEFAULT, draw_camera
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR
from deepaccident_devkit.render.video import VIEWS, Scene, names_at, render_scenario_video, views_of, write_video
from deepaccident_devkit.tables.tokens import frame_token
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".mp4", ".gif", ".webp"])
def test_a_video_has_all_frames_in_order_at_its_size(video: Callable[..., Path], suffix: str) -> None:
    path = video(f"v{suffix}")
    assert greys(path) == [1, 2, 3, 4, 5, 6]
    assert all(picture.shape == (SIZE[1], SIZE[0], 3) for picture in decoded(path))
    assert [each.name for each in path.parent.iterdir()] == [path.name]


@pytest.mark.slow
def test_two_workers_write_the_same_bytes_as_one(video: Callable[..., Path]) -> None:
    one, two = (video(f"{count}.mp4", what=[grey, "bev"], frames=slice(0, 3), workers=count) for count in (1, 2))
    assert one.read_bytes() == two.read_bytes()


@pytest.mark.slow
def test_an_executor_writes_the_same_bytes(video: Callable[..., Path]) -> None:
    with ThreadPoolExecutor(3) as executor:
        sent = video("sent.mp4", what="bev", executor=executor)
    assert sent.read_bytes() == video("own.mp4", what="bev", workers=1).read_bytes()


@pytest.mark.slow
def test_the_same_pictures_are_the_same_bytes(da: DeepAccident, accident: str, tmp_path: Path) -> None:
    """Whatever the memory held that the encoder gets; rare, hence many times."""
    scene = Scene(dataset=da, views=views_of([grey, "bev"], None), agents=None, width=SIZE[0], height=SIZE[1])
    pictures = [scene.picture(frame_token(accident, number)) for number in (1, 2, 3)]
    rng = np.random.default_rng(0)
    for number in range(400):
        used = [np.full(size, number % 256, np.uint8) for size in rng.integers(1, 3_000_000, size=8)]
        del used[::2]
        write_video(tmp_path / f"{number}.mp4", pictures, fps=10)
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 1


@pytest.mark.slow
def test_frames_are_numbers_in_any_order_or_a_slice_of_all(video: Callable[..., Path]) -> None:
    assert greys(video("a.gif", frames=range(5, 1, -2))) == [5, 3]
    assert greys(video("b.gif", frames=slice(-2, None))) == [5, 6]
    assert greys(video("c.gif", frames=slice(None, None, 5))) == [1, 6]


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
        video(f"v{suffix}", what=breaks)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(f"v{suffix}", "old")]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"name": "v.avi"}, r"path: expected a file that ends in \.mp4, \.gif, \.webp, found '.*v\.avi'"),
        ({"size": (161, 90)}, "size: expected an even width and height, which MP4 needs"),
        ({"size": (0, 90)}, "size: expected width and height of at least 16 pixels"),
        ({"fps": 0}, "fps: expected frames a second, above 0"),
        ({"what": "film"}, "what: expected one of frame, sample, accident, .*, found 'film'"),
        ({"what": []}, "what: expected at least one of frame, "),
        ({"what": "bev", "layers": ["image"]}, "layers: expected one of .*bev.*, found 'image'"),
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


@pytest.fixture(scope="session")
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


@pytest.mark.slow
def test_views_side_by_side_have_their_shares_of_the_width(da: DeepAccident, accident: str) -> None:
    frame = f"{accident}/004"
    views = views_of(["bev", "frame", grey], None)
    picture = Scene(dataset=da, views=views, agents=None, width=400, height=90).picture(frame)
    assert picture.shape == (90, 400, 3)
    assert VIEWS["frame"].share == 2
    assert (picture[:, 300:] == 4 * STEP).all()
    assert (picture[:, 299] != 4 * STEP).all()
    assert (picture[:, :100] != 255).any()


@pytest.mark.slow
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
        camera = dataset.get("sample_data", f"{accident}/other_vehicle/003/Camera_Back")
        draw_camera(dataset, camera, CAMERA_DEFAULT, fig.add_subplot())

    own = Scene(dataset=da, views=views_of(draw, None), agents=None, width=320, height=180)
    np.testing.assert_array_equal(scene.picture(frame), own.picture(frame))


def test_each_view_draws_those_of_the_layers_that_it_has() -> None:
    chosen = [layers for _, layers in views_of(["Camera_Front", "bev", "visibility_matrix"], ["image", "boxes"])]
    assert chosen == [("image", "boxes"), ("boxes",), ()]
    assert [layers for _, layers in views_of(["Camera_Front", "bev"], None)] == [None, None]


@pytest.mark.slow
@pytest.mark.parametrize("what", [("frame", "visibility", "bev"), ("frame", "sample", "labels")])
def test_words_keep_their_room_beside_other_views(da: DeepAccident, accident: str, what: tuple[str, ...]) -> None:
    """Nothing is written over a view's left or right edge; matplotlib warns, which is an error here, if it gives up."""
    scene = Scene(dataset=da, views=views_of(what, None), agents=None, width=1280, height=720)
    picture, total = scene.picture(f"{accident}/002").astype(int), sum(VIEWS[name].share for name in what)
    edges = np.cumsum([0, *(VIEWS[name].share for name in what)]) * 1280 // total
    for left, right in pairwise(edges.tolist()):
        assert (picture[:, [left, right - 1]] > 250).all()


@pytest.mark.parametrize("suffix", [".mp4", ".gif", ".webp"])
def test_colors_are_right_in_the_file(video: Callable[..., Path], suffix: str) -> None:
    picture = decoded(video(f"v{suffix}", what=colors, frames=[1]))[0]
    np.testing.assert_allclose(picture[45, 40], (255, 0, 0), atol=20)
    np.testing.assert_allclose(picture[45, 120], (0, 0, 255), atol=20)


def test_few_pixels_keep_their_color_in_a_gif(tmp_path: Path) -> None:
    """A box is some pixels of a picture of thousands of other colours."""
    rng = np.random.default_rng(0)
    photo = rng.integers(60, 140, (90, 160, 3), dtype=np.uint8)
    marks = {(10, 20): COLLIDER_COLOR, (50, 60): AGENT_COLORS["ego_vehicle"]}
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


@pytest.mark.parametrize("name", ["v.mp4", "v.MP4"])
def test_without_av_mp4_is_refused_before_anything_is_drawn(
    video: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingExtraError, match=r"MP4 needs PyAV: .*\[video\]'; or choose \.gif or \.webp$"):
        video(name, what=lambda *_: pytest.fail("drawn"))
    assert not list(tmp_path.iterdir())


def test_a_folder_is_no_video(da: DeepAccident, accident: str, tmp_path: Path) -> None:
    (tmp_path / "a.gif").mkdir()
    with pytest.raises(ChoiceError, match="path: expected a file, found the folder"):
        render_scenario_video(da, accident, tmp_path / "a.gif")
