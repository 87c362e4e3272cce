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
from scripts import loaded_script

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import style, styles
from deepaccident_devkit.render.figures import save_picture
from deepaccident_devkit.render.motion_maps import direction_colors
from deepaccident_devkit.render.statistics import render_statistics
from deepaccident_devkit.render.training import render_curve
from deepaccident_devkit.statistics import dataset_statistics

HOSTILE: dict[str, Any] = {
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


def moment(da: DeepAccident, sample: str) -> str:
    token: str = da.get("sample", sample)["frame_token"]
    return token


def scenario(sample: str) -> str:
    return sample.rsplit("/", 2)[0]


PICTURES: dict[str, Draw] = {
    "bev": lambda da, sample: da.render_bev(sample),
    "camera": lambda da, sample: da.render_sample_data(f"{sample}/Camera_Front"),
    "sample": lambda da, sample: da.render_sample(sample),
    "frame": lambda da, sample: da.render_frame(moment(da, sample)),
    "annotation": lambda da, _: da.render_annotation(da.annotation[0]),
    "visibility": lambda da, sample: da.render_visibility(moment(da, sample)),
    "accident": lambda da, sample: da.render_accident(scenario(sample), seconds=(1.0, 0.0)),
    "motion labels": lambda da, sample: da.render_motion_labels(sample),
    "town map": lambda da, sample: da.render_town_map(da.get("scenario", scenario(sample))["town"]),
    "statistics": lambda da, _: render_statistics(dataset_statistics(da, workers=1), "scenarios"),
    "curve": lambda *_: render_curve([1, 2, 3], [-1.0, 2.0, -3.0], "loss"),
}


def curve() -> Any:
    return render_curve([1, 2, 3], [-1.0, 2.0, -3.0], "loss")


def pixels(drawn: Any) -> Any:
    canvas: Any = FigureCanvasAgg(drawn.figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba()).copy()


@pytest.fixture(scope="module")
def sample(da: DeepAccident) -> str:
    """Of the ego, at the impact."""
    accident = next(each for each in da.scenario if each["collision"])
    return f"{accident['token']}/ego_vehicle/{accident['num_frames']:03d}"


@pytest.mark.slow
@pytest.mark.parametrize("name", PICTURES)
def test_no_setting_of_the_user_changes_a_picture(
    da: DeepAccident, da_motion: DeepAccident, sample: str, name: str
) -> None:
    if name == "motion labels":  # a sample with a past and a future
        da, accident = da_motion, next(each for each in da_motion.scenario if each["collision"])
        sample = da.get_sample(accident, "ego_vehicle", accident["num_frames"] - 10)["token"]
    usual = pixels(PICTURES[name](da, sample))
    with mpl.rc_context(HOSTILE):
        theirs = dict(mpl.rcParams)
        np.testing.assert_array_equal(pixels(PICTURES[name](da, sample)), usual)
        assert dict(mpl.rcParams) == theirs


def test_no_setting_of_the_user_changes_a_file(tmp_path: Path) -> None:
    """Nor if it is other when the figure is saved; and a figure that went through a pickle stays
    one of ours.
    """
    written = []
    for settings in ({}, HOSTILE):
        drawn = curve()
        with mpl.rc_context(settings):
            pickle.loads(pickle.dumps(drawn.figure)).savefig(tmp_path / "own.png")
            save_picture(drawn, tmp_path / "a.png")
        written.append([(tmp_path / name).read_bytes() for name in ("own.png", "a.png")])
    assert written[0] == written[1]


def test_axes_of_the_user_stay_theirs_but_images_stand_upright(
    da: DeepAccident, sample: str
) -> None:
    with mpl.rc_context({"image.origin": "lower", "axes.facecolor": "black"}):
        _, ax = plt.subplots()
        da.render_sample_data(f"{sample}/Camera_Front", ax=ax)
    assert (ax.get_facecolor()[:3], ax.images[0].origin) == ((0, 0, 0), "upper")


def test_a_figure_keeps_the_style_that_it_was_made_in() -> None:
    with style("paper"):
        paper = curve()
        inside = pixels(paper)
    assert paper.xaxis.label.get_fontsize() == 7
    np.testing.assert_array_equal(pixels(paper), inside)


EYES = ("normal", "protanopia", "deuteranopia", "tritanopia")


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return loaded_script("docs/check_colors.py")


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize(
    ("group", "bound"),
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
    script: ModuleType, group: str, bound: float, eye: str
) -> None:
    assert script.least_distance(script.GROUPS[group], eye) >= bound


def test_nothing_but_the_pair_is_red(script: ModuleType) -> None:
    maps = [styles.DEPTH_COLORMAP, styles.HEIGHT_COLORMAP, styles.CENTERNESS_COLORMAP]
    mapped = [to_hex(colormaps[name](share)) for name in maps for share in np.linspace(0, 1, 33)]
    turns = np.linspace(0, 2 * np.pi, 65)
    flow = [to_hex(each) for each in direction_colors(np.sin(turns), np.cos(turns), longest=1.0)]
    others = [
        each
        for name, value in vars(styles).items()
        if name.isupper() and name[0] != "_" and name not in ("COLLIDER_COLOR", "CATEGORY_MARKERS")
        for each in (
            [value]
            if isinstance(value, str)
            else value.values()
            if hasattr(value, "values")
            else value
        )
        if each.startswith("#")
    ]
    assert len(others) > 40
    assert script.distances([*mapped, *flow, *others], [styles.COLLIDER_COLOR]).min() > 33
