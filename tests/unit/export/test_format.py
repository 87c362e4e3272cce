"""Settings of a format, and the flat names of scenarios."""

import re
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.expected_errors import assert_raises
from support.tiny_format import TinyFormat

from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.export.bulk import Format, flat_name
from deepaccident_devkit.export.clips import Clips
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.export.opencood import OpenCood
from deepaccident_devkit.export.parquet import Parquet
from deepaccident_devkit.export.questions import Questions, WindowRules
from deepaccident_devkit.export.release import ReleasePart
from deepaccident_devkit.export.released_infos import ReleasedInfos
from deepaccident_devkit.training.image_cache import CachedImages

TYPE = "type1_subtype1_accident"
TOKENS = st.text(
    st.characters(exclude_categories=("Cs",), exclude_characters="/\0"), min_size=1, max_size=250
)


def test_choices_get_their_usual_spelling_and_order() -> None:
    form = TinyFormat(
        agents=("Infrastructure", "EGO_VEHICLE", "ego_vehicle"),
        link="Copy",
        split="VAL",
        where="length>=3",
    )  # type: ignore[arg-type]
    usual_form = TinyFormat(
        agents=("ego_vehicle", "infrastructure"), link="copy", split="val", where=("length>=3",)
    )

    assert form == usual_form
    assert form.settings() == usual_form.settings()
    assert TinyFormat(agents="ego_vehicle").agents == ("ego_vehicle",)  # type: ignore[arg-type]


ONE_SIZE = ImageConfig(resize=(18, 30))


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (TinyFormat, {"agents": ("ego",)}, "agents: expected one of"),
        (TinyFormat, {"agents": ()}, "agents: expected some of .*found none"),
        (TinyFormat, {"link": "soft"}, "link: expected one of hard, symbolic, copy, found 'soft'"),
        (TinyFormat, {"split": "trian"}, "split: expected one of .*did you mean 'train'"),
        (TinyFormat, {"where": ("town",)}, "expected field=value"),
        (TinyFormat, {"where": (len,)}, "expected a text such as"),
        (NuScenes, {"van": "bus"}, "van: expected one of car, truck"),
        (NuScenes, {"lidar_axes": "kitti"}, "lidar_axes: expected one of ego, nuscenes"),
        (OpenCood, {"ego": "infrastructure"}, "ego: expected one of ego_vehicle"),
        (OpenCood, {"classes": ()}, "classes: expected some of car"),
        (OpenCood, {"classes": ("bus",)}, "classes: expected one of car"),
        (ReleasedInfos, {"agents": ("ego_vehicle",)}, "agents: the released classes need all five"),
        (ReleasedInfos, {"root_prefix": "./data\n/DeepAccident"}, "root_prefix: expected a path"),
        (Clips, {"cameras": ("Camera_Up",)}, "^cameras: expected one of Camera_Front"),
        (ReleasePart, {"channels": ("label",)}, "channels: expected one of Camera_Front"),
        (CachedImages, {"images": ONE_SIZE, "codec": "png"}, "codec: expected one of raw, jpeg"),
        (Questions, {"observers": "nobody"}, "^observers: expected one of single"),
        (
            Questions,
            {"observers": ("ego_vehicle", "me")},
            "^observers: expected one of ego_vehicle",
        ),
        (Questions, {"seen": "heard"}, "^seen: expected one of released, camera, annotated"),
        (Questions, {"cameras": ("Camera_Up",)}, "^cameras: expected one of Camera_Front"),
        (Questions, {"link": "symbolic"}, "^link: a symbolic link shows the name of the scenario"),
    ],
)
def test_a_wrong_choice_is_refused_before_a_release_is_opened(
    kind: type[Format], options: dict[str, Any], message: str
) -> None:
    assert_raises((lambda: kind(**options), ChoiceError, message))


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (Clips, {"quality": 52}, "quality: expected a number from 0 to 51, found 52"),
        (Clips, {"size": (640,)}, "size: expected width and height in pixels, found"),
        (ReleasePart, {"size": (640,)}, "size: expected width and height in pixels, found"),
        (Parquet, {"shard_scenarios": 0}, "shard_scenarios: .*from 1.*0"),
        (
            CachedImages,
            {"images": ImageConfig()},
            "a cache has images of one size; give ImageConfig",
        ),
        (ImageConfig, {"decode": "half"}, "decode: expected one of full, scaled"),
        (Questions, {"seed": 3}, "^seed: expected text, found 3"),
        (Questions, {"window": 5}, "^window: expected WindowRules, found int"),
        (
            WindowRules,
            {"observe": 0.3},
            "^observe: expected seconds from 0 in steps of 0.5, found 0.3",
        ),
        (WindowRules, {"observe": -1}, "^observe: expected seconds from 0"),
        (WindowRules, {"observe": float("nan")}, "^observe: expected"),
        (WindowRules, {"stride": 0}, "^stride: expected seconds from 0.5 in steps of 0.5, found 0"),
        (WindowRules, {"stride": 0.7}, "^stride: expected seconds from 0.5"),
        (WindowRules, {"ahead": 0}, "^ahead: expected a whole number from 1, found 0"),
    ],
)
def test_impossible_settings_are_refused(
    kind: Callable[..., object], options: dict[str, Any], message: str
) -> None:
    assert_raises((lambda: kind(**options), ConfigError, message))


class TestNames:
    def test_published_names_stay_plain(self) -> None:
        name = "Town03_type001_subtype0001_scenario00024"
        assert flat_name(f"{TYPE}/{name}") == f"{TYPE}__{name}"

    @given(TOKENS, TOKENS)
    def test_two_tokens_have_two_names_of_few_characters(self, a: str, b: str) -> None:
        first, second = flat_name(f"{TYPE}/{a}"), flat_name(f"{TYPE}/{b}")
        assert (first == second) == (a == b)
        assert re.fullmatch(r"[!-~]{1,199}", first)
        assert not set(first) & set('/\\:*?"<>|')

    @pytest.mark.parametrize("odd", ["a b", "a\nb", "ä_b", "a" * 240])
    def test_similar_names_stay_different(self, odd: str) -> None:
        flat = flat_name(f"{TYPE}/{odd}")
        similar_names = (flat.split("__")[1], "a_b", "__b", "a" * 241)
        flat_names = {flat, *(flat_name(f"{TYPE}/{name}") for name in similar_names)}
        assert len(flat_names) == 1 + len(similar_names)
