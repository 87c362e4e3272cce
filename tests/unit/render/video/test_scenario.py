"""Videos: what is in the file is what the views draw, in order; and nothing half-written."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from video_views import SIZE, decoded, grey, greys

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.render.video import Scene, views_of, write_video
from deepaccident_devkit.tables.tokens import frame_token

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("suffix", [".mp4", ".gif", ".webp"])
def test_a_video_has_all_frames_in_order_at_its_size(video: Callable[..., Path], suffix: str) -> None:
    path = video(f"v{suffix}")
    assert greys(path) == [1, 2, 3, 4, 5, 6]
    assert all(picture.shape == (SIZE[1], SIZE[0], 3) for picture in decoded(path))
    assert [each.name for each in path.parent.iterdir()] == [path.name]


def test_two_workers_write_the_same_bytes_as_one(video: Callable[..., Path]) -> None:
    one, two = (video(f"{count}.mp4", what=[grey, "bev"], frames=slice(0, 3), workers=count) for count in (1, 2))
    assert one.read_bytes() == two.read_bytes()


def test_an_executor_writes_the_same_bytes(video: Callable[..., Path]) -> None:
    with ThreadPoolExecutor(3) as executor:
        sent = video("sent.mp4", what="bev", executor=executor)
    assert sent.read_bytes() == video("own.mp4", what="bev", workers=1).read_bytes()


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


def test_frames_are_numbers_in_any_order_or_a_slice_of_all(video: Callable[..., Path]) -> None:
    assert greys(video("a.gif", frames=range(5, 1, -2))) == [5, 3]
    assert greys(video("b.gif", frames=slice(-2, None))) == [5, 6]
    assert greys(video("c.gif", frames=slice(None, None, 5))) == [1, 6]


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
