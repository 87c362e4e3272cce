"""Pictures depend on their style, and on no setting of the user's matplotlib."""

import pickle
import re
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

import deepaccident_devkit
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.plugins.safety import lead_time_ledger
from deepaccident_devkit.plugins.safety.figures import render_lead_times
from deepaccident_devkit.render import detached_figure, style, styles
from deepaccident_devkit.render.figures import save_picture
from deepaccident_devkit.render.motion_maps import direction_colors
from deepaccident_devkit.render.notebook import png_of
from deepaccident_devkit.render.statistics import render_statistics
from deepaccident_devkit.render.training import render_curve
from deepaccident_devkit.render.video import VideoScene, views_of
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
    "sample, detached": lambda da, sample: da.render_sample(sample, fig=detached_figure((16, 5.6))),
    "frame": lambda da, sample: da.render_frame(moment(da, sample)),
    "annotation": lambda da, _: da.render_annotation(da.annotation[0]),
    "instance": lambda da, _: da.render_instance(da.instance[0]),
    "visibility": lambda da, sample: da.render_visibility(moment(da, sample)),
    "visibility matrix": lambda da, sample: da.render_visibility_matrix(moment(da, sample)),
    "calibration": lambda da, sample: da.render_calibration(moment(da, sample)),
    "accident": lambda da, sample: da.render_accident(scenario(sample), seconds=(1.0, 0.0)),
    "motion labels": lambda da, sample: da.render_motion_labels(sample),
    "town map": lambda da, sample: da.render_town_map(da.get("scenario", scenario(sample))["town"]),
    "lead times": lambda da, _: render_lead_times(lead_time_ledger(da)),
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
    """Nor if it is other when the figure is saved; and a figure that went through a pickle stays one of ours."""
    written = []
    for settings in ({}, HOSTILE):
        drawn = curve()
        with mpl.rc_context(settings):
            pickle.loads(pickle.dumps(drawn.figure)).savefig(tmp_path / "own.png")
            save_picture(drawn, tmp_path / "a.png")
        written.append([(tmp_path / name).read_bytes() for name in ("own.png", "a.png")])
    assert written[0] == written[1]


def test_a_video_and_what_a_notebook_shows_know_no_setting(da_motion: DeepAccident) -> None:
    sample, made = da_motion.sample[40], []
    for settings in ({}, HOSTILE):
        with mpl.rc_context(settings):
            scene = VideoScene(dataset=da_motion, views=views_of("bev", None), agents=None, width=160, height=160)
            made.append((scene.picture(sample["frame_token"]).tobytes(), png_of(da_motion.boxes(sample))))
    assert made[0] == made[1]


def test_axes_of_the_user_stay_theirs_but_images_stand_upright(da: DeepAccident, sample: str) -> None:
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


PACKAGE = Path(deepaccident_devkit.__file__).parent
PAINTED = ("synth", "testing")
"""These paint a world for cameras, not pictures for readers."""


NAMING = (".py", ".js", ".css", ".html")
"""Files that may name colours."""
HEX = re.compile(r"#(?:[0-9a-fA-F]{8}|[0-9a-fA-F]{6}|[0-9a-fA-F]{3,4})\b")
EYES = ("normal", "protanopia", "deuteranopia", "tritanopia")


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return loaded_script("docs/check_colors.py")


def test_the_measures_agree_with_known_values(script: ModuleType) -> None:
    np.testing.assert_allclose(script.lab(["#ff0000", "#ffffff"]), [[53.24, 80.09, 67.20], [100, 0, 0]], atol=0.02)
    np.testing.assert_allclose(script.contrast(["#000000", "#777777"], "#ffffff"), [21, 4.48], atol=0.01)
    seen = script.distances(["#808080"], ["#808080"], "deuteranopia")
    np.testing.assert_allclose([*seen.ravel(), *script.chroma(["#808080"])], 0, atol=0.02)
    assert script.least_distance(["#ff0000", "#808000"], "deuteranopia") < 40 < script.least_distance(["#f00", "#880"])


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
def test_colours_that_stand_together_are_distinguished(script: ModuleType, group: str, bound: float, eye: str) -> None:
    assert script.least_distance(script.GROUPS[group], eye) >= bound


def test_saturation_is_the_agents_and_the_pairs_alone(script: ModuleType) -> None:
    vivid = script.GROUPS["agents and the pair"]
    muted = [*styles.OUTCOME_COLORS.values(), styles.PREDICTED_COLOR, styles.ESTIMATE_COLOR]
    tables = (styles.CATEGORY_COLORS, styles.SPLIT_COLORS, styles.BEV_COLORS)
    shades = [*(color for each in tables for color in each.values()), *styles.INSTANCE_COLORS, *styles.SERIES_COLORS]
    assert script.chroma(vivid).min() > 36
    assert script.chroma(muted).max() < 40
    assert script.chroma(shades).max() < 17
    assert script.distances(muted, vivid).min() > 25


def test_nothing_but_the_pair_is_red(script: ModuleType) -> None:
    maps = [styles.DEPTH_COLORMAP, styles.HEIGHT_COLORMAP, styles.CENTERNESS_COLORMAP]
    mapped = [to_hex(colormaps[name](share)) for name in maps for share in np.linspace(0, 1, 33)]
    turns = np.linspace(0, 2 * np.pi, 65)
    flow = [to_hex(each) for each in direction_colors(np.sin(turns), np.cos(turns), longest=1.0)]
    others = [
        each
        for name, value in vars(styles).items()
        if name.isupper() and name[0] != "_" and name not in ("COLLIDER_COLOR", "CATEGORY_MARKERS")
        for each in ([value] if isinstance(value, str) else value.values() if hasattr(value, "values") else value)
        if each.startswith("#")
    ]
    assert len(others) > 40
    assert script.distances([*mapped, *flow, *others], [styles.COLLIDER_COLOR]).min() > 33


def test_words_can_be_read_and_marks_be_seen(script: ModuleType) -> None:
    words = [styles.COLLIDER_COLOR, styles.OWN_COLOR, styles.MUTED_COLOR, styles.WARNING_COLOR, styles.LINK_COLOR]
    assert script.contrast(words, "#ffffff").min() >= 4.5  # WCAG's bound for words
    assert script.contrast(styles.CATEGORY_COLORS.values(), "#ffffff").min() >= 2.5
    for ground, bound in (("white", 2.0), ("road", 1.6)):
        assert script.contrast(styles.AGENT_COLORS.values(), script.GROUNDS[ground]).min() >= bound


def test_colours_come_from_the_one_table() -> None:
    """Pages may have greys of their own: of their lines, grounds and words."""
    found = []
    for path in sorted(PACKAGE.rglob("*")):
        name, text = path.relative_to(PACKAGE), ""
        if name.parts[0] not in PAINTED and name.as_posix() != "render/styles.py" and path.suffix in NAMING:
            text = path.read_text(encoding="utf-8")
        functions = re.findall(r"\brgba?\(|\bhsla?\(", text) if path.suffix != ".py" else []
        colors = [color for color in HEX.findall(text) if not is_grey(color)]
        found += [f"{name}: {color}" for color in (*colors, *functions)]
    assert found == []


def is_grey(color: str) -> bool:
    red, green, blue = (int(each, 16) for each in re.findall("..", to_hex(color)[1:]))
    return max(red, green, blue) - min(red, green, blue) <= 4
