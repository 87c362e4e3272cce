"""Video files: what players make of them."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgba
from PIL import Image
from video_views import colors, decoded

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, MissingExtraError
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR
from deepaccident_devkit.render.video import render_scenario_video, write_video


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
