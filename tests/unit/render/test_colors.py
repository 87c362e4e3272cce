"""The colour table keeps its promises to normal and colour-blind eyes; `docs/check_colors.py` prints the numbers."""

import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.colors import to_hex
from scripts import loaded_script

import deepaccident_devkit
from deepaccident_devkit.render import styles
from deepaccident_devkit.render.motion_maps import direction_colors

PACKAGE = Path(deepaccident_devkit.__file__).parent
PAINTED = ("synth", "testing")
"""These paint a world for cameras, not pictures for readers."""
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
        ("series", 16),
        ("splits", 17),
    ],
)
def test_colours_that_stand_together_are_distinguished(script: ModuleType, group: str, bound: float, eye: str) -> None:
    assert script.least_distance(script.GROUPS[group], eye) >= bound


def test_saturation_is_the_agents_and_the_pairs_alone(script: ModuleType) -> None:
    vivid = script.GROUPS["agents and the pair"]
    muted = [*styles.OUTCOME_COLORS.values(), styles.PREDICTED_COLOR, styles.ESTIMATE_COLOR]
    shades = [
        *styles.CATEGORY_COLORS.values(),
        *styles.INSTANCE_COLORS,
        *styles.SERIES_COLORS,
        *styles.SPLIT_COLORS.values(),
        *styles.BEV_COLORS.values(),
    ]
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


def sources(*suffixes: str) -> Iterator[tuple[str, str]]:
    """Names and texts of the package's files that may name colours."""
    for path in sorted(PACKAGE.rglob("*")):
        name = path.relative_to(PACKAGE)
        if path.suffix in suffixes and name.parts[0] not in PAINTED and name.as_posix() != "render/styles.py":
            yield name.as_posix(), path.read_text(encoding="utf-8")


def test_colours_come_from_the_one_table() -> None:
    """Pages may have greys of their own: of their lines, grounds and words."""
    found = [
        f"{name}: {color}"
        for name, text in sources(".py", ".js", ".css", ".html")
        for color in HEX.findall(text)
        if not is_grey(color)
    ]
    found += [
        f"{name}: {color}"
        for name, text in sources(".js", ".css", ".html")
        for color in re.findall(r"\brgba?\(|\bhsla?\(", text)
    ]
    assert found == []


def is_grey(color: str) -> bool:
    red, green, blue = (int(each, 16) for each in re.findall("..", to_hex(color)[1:]))
    return max(red, green, blue) - min(red, green, blue) <= 4
