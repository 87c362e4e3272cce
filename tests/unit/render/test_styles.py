"""Pictures depend on their style, and on no setting of the user's matplotlib."""

import pickle
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib import pyplot as plt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from support.replay_page import accident_scenario
from support.repository_scripts import load_script

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import style, styles
from deepaccident_devkit.render.figures import figure_or_new, save_picture
from deepaccident_devkit.render.motion_maps import direction_colors
from deepaccident_devkit.render.statistics import render_statistics
from deepaccident_devkit.render.styles import lines_height
from deepaccident_devkit.render.training import render_curve
from deepaccident_devkit.statistics import dataset_statistics

HOSTILE_SETTINGS: dict[str, Any] = {
    "axes.axisbelow": False,
    "axes.facecolor": "black",
    "axes.formatter.limits": (0, 0),
    "axes.grid": True,
    "axes.prop_cycle": mpl.cycler(color=["red", "black"]),
    "axes.spines.left": False,
    "axes.titlesize": 40,
    "axes.unicode_minus": False,
    "axes.xmargin": 0.4,
    "figure.dpi": 47,
    "figure.facecolor": "red",
    "figure.titlesize": 40,
    "font.family": "monospace",
    "font.size": 22,
    "image.aspect": "auto",
    "image.cmap": "hot",
    "image.interpolation": "bicubic",
    "image.origin": "lower",
    "legend.fontsize": 30,
    "lines.linewidth": 9,
    "patch.linewidth": 8,
    "savefig.bbox": "tight",
    "savefig.dpi": 33,
    "savefig.facecolor": "blue",
    "savefig.transparent": True,
    "scatter.marker": "x",
    "svg.fonttype": "none",
    "text.usetex": True,
    "xtick.labelsize": 30,
}
Draw = Callable[[DeepAccident, str], Any]


def frame_of(da: DeepAccident, sample: str) -> str:
    return str(da.get("sample", sample)["frame_token"])


def scenario_of(sample: str) -> str:
    return sample.rsplit("/", 2)[0]


PICTURES: dict[str, Draw] = {
    "bev": lambda da, sample: da.render_bev(sample),
    "camera": lambda da, sample: da.render_sample_data(f"{sample}/Camera_Front"),
    "sample": lambda da, sample: da.render_sample(sample),
    "frame": lambda da, sample: da.render_frame(frame_of(da, sample)),
    "annotation": lambda da, _: da.render_annotation(da.annotation[0]),
    "visibility": lambda da, sample: da.render_visibility(frame_of(da, sample)),
    "accident": lambda da, sample: da.render_accident(scenario_of(sample), seconds=(1.0, 0.0)),
    "teaser": lambda da, sample: da.render_teaser(scenario_of(sample), seconds=(1.0, 0.0)),
    "motion labels": lambda da, sample: da.render_motion_labels(sample),
    "town map": lambda da, sample: da.render_town_map(
        da.get("scenario", scenario_of(sample))["town"]
    ),
    "statistics": lambda da, _: render_statistics(dataset_statistics(da, workers=1), "scenarios"),
    "curve": lambda *_: draw_curve(),
}


def draw_curve() -> Any:
    return render_curve([1, 2, 3], [-1.0, 2.0, -3.0], "loss")


def render_pixels(drawn: Any) -> Any:
    canvas: Any = FigureCanvasAgg(drawn.figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba()).copy()


@pytest.fixture(scope="module")
def sample(da: DeepAccident) -> str:
    """The token of the ego's sample at the impact."""
    scenario = da.get("scenario", accident_scenario(da))
    return f"{scenario['token']}/ego_vehicle/{scenario['num_frames']:03d}"


@pytest.mark.slow
@pytest.mark.parametrize("name", PICTURES)
def test_no_setting_of_the_user_changes_a_picture(
    da: DeepAccident, da_motion: DeepAccident, sample: str, name: str
) -> None:
    draw = PICTURES[name]
    if name == "motion labels":  # a sample with a past and a future
        da = da_motion
        scenario = da.get("scenario", accident_scenario(da))
        sample = da.get_sample(scenario, "ego_vehicle", scenario["num_frames"] - 10)["token"]
    expected = render_pixels(draw(da, sample))

    with mpl.rc_context(HOSTILE_SETTINGS):
        settings = dict(mpl.rcParams)
        np.testing.assert_array_equal(render_pixels(draw(da, sample)), expected)
        assert dict(mpl.rcParams) == settings


def test_no_setting_of_the_user_changes_a_file(tmp_path: Path) -> None:
    """Settings may differ when the figure is saved, and a pickled figure keeps its style."""
    contents = []
    for settings in ({}, HOSTILE_SETTINGS):
        curve = draw_curve()
        with mpl.rc_context(settings):
            pickle.loads(pickle.dumps(curve.figure)).savefig(tmp_path / "own.png")
            save_picture(curve, tmp_path / "a.png")
        contents.append([(tmp_path / name).read_bytes() for name in ("own.png", "a.png")])

    assert contents[0] == contents[1]


def test_the_user_s_axes_keep_their_style_but_images_stand_upright(
    da: DeepAccident, sample: str
) -> None:
    with mpl.rc_context({"image.origin": "lower", "axes.facecolor": "black"}):
        _, ax = plt.subplots()
        da.render_sample_data(f"{sample}/Camera_Front", ax=ax)
    assert (ax.get_facecolor()[:3], ax.images[0].origin) == ((0, 0, 0), "upper")


@pytest.mark.parametrize(
    ("name", "ratio"),
    [("cvpr-page", 0.6), ("ieee-page", 0.6), ("slide", 9 / 16), ("cvpr-column", 1.2)],
)
def test_a_map_over_a_page_is_not_as_high_as_the_page(
    da: DeepAccident, sample: str, name: Any, ratio: float
) -> None:
    with style(name):
        views = [
            da.render_bev(sample, layers=["boxes"]),
            da.render_visibility(sample),
            da.render_motion_labels(sample, style="trail"),
        ]
        for view in views:
            width, height = view.figure.get_size_inches()
            assert height / width == pytest.approx(ratio, abs=0.09)


@pytest.mark.parametrize("lines", [0, 20, 60])
def test_a_slide_of_any_number_of_lines_is_16_9(lines: int) -> None:
    with style("slide"):
        width, height = figure_or_new(None, (5, 9), lines=lines).get_size_inches()
        assert width / height == pytest.approx(16 / 9)
        assert height >= lines_height(lines)
        assert width >= 8


def test_a_figure_keeps_the_style_that_it_was_made_in() -> None:
    with style("paper"):
        curve = draw_curve()
        pixels_inside = render_pixels(curve)
    assert curve.xaxis.label.get_fontsize() == 7
    np.testing.assert_array_equal(render_pixels(curve), pixels_inside)


COLOR_VISIONS = ("normal", "protanopia", "deuteranopia", "tritanopia")


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return load_script("docs/check_colors.py")


def list_colors(value: Any) -> list[str]:
    """List the colours in a constant, which may be a string, a sequence or a dictionary."""
    if isinstance(value, str):
        strings = [value]
    else:
        strings = value.values() if hasattr(value, "values") else value
    return [text for text in strings if text.startswith("#")]


@pytest.mark.parametrize("color_vision", COLOR_VISIONS)
@pytest.mark.parametrize(
    ("group", "min_distance"),
    [
        ("agents and the pair", 18),
        ("verdicts", 29),
        ("classes of vehicles", 18),
        ("all classes", 9),
        ("classes by choice, and the pair", 33),
        ("series", 16),
        ("splits", 17),
        ("a town's ground", 9),
    ],
)
def test_colours_that_stand_together_are_distinguished(
    script: ModuleType, group: str, min_distance: float, color_vision: str
) -> None:
    assert script.least_distance(script.GROUPS[group], color_vision) >= min_distance


def test_nothing_but_the_pair_is_red(script: ModuleType) -> None:
    colormap_names = [styles.DEPTH_COLORMAP, styles.HEIGHT_COLORMAP, styles.CENTERNESS_COLORMAP]
    shares = np.linspace(0, 1, 33)
    mapped = [to_hex(colormaps[name](share)) for name in colormap_names for share in shares]
    angles = np.linspace(0, 2 * np.pi, 65)
    flow_colors = direction_colors(np.sin(angles), np.cos(angles), longest=1.0)
    flow = [to_hex(color) for color in flow_colors]
    constants = [
        color
        for name, value in vars(styles).items()
        if name.isupper() and name[0] != "_" and name not in ("COLLIDER_COLOR", "CATEGORY_MARKERS")
        for color in list_colors(value)
    ]

    assert len(constants) > 40
    colors = [*mapped, *flow, *constants]
    assert script.distances(colors, [styles.COLLIDER_COLOR]).min() > 33
