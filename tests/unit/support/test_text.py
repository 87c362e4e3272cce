"""Words that the devkit knows are taken in any case of letters; errors on other words suggest the
word that was meant.
"""

from collections.abc import Callable
from typing import Any

import click
import numpy as np
import pytest
from support.command_calls import walk_commands
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.cli.agents import agent_names, names_or_configuration
from deepaccident_devkit.cli.verbs import WordChoice
from deepaccident_devkit.errors import (
    ChoiceError,
    ConfigError,
    DeepAccidentError,
    TableError,
    TokenError,
    VersionError,
)
from deepaccident_devkit.evaluation import (
    AccidentEvaluator,
    DetectionEvaluator,
    MotionEvaluator,
    WarningEvaluator,
)
from deepaccident_devkit.evaluation.runs import SampleSelection
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.export.mcap import McapConfig
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import MotionLabelConfig, agents_to_ego, config_from_names
from deepaccident_devkit.plugins.baselines import Baseline
from deepaccident_devkit.plugins.synth import SynthConfig
from deepaccident_devkit.release import find_release
from deepaccident_devkit.render.figures import layers_of
from deepaccident_devkit.support.text import choice, differing_text, distinct_names, meant_text
from deepaccident_devkit.testing import SmallRelease
from deepaccident_devkit.v2x import AgentConfig, cooperating_agents

SETTINGS = {"grid_conf": {"xbound": (-50.0, 50.0, 0.5), "ybound": (-30.0, 50.0, 0.5)}}


def warp_dtype(mode: str) -> np.dtype:
    frames = np.zeros((2, 200, 200), dtype=np.int16)
    return agents_to_ego(frames, np.zeros((2, 6)), mode=mode).dtype


CALLS: list[tuple[str, str, str, type[DeepAccidentError], Callable[[DeepAccident, str], Any]]] = [
    ("LIDAR", "lidar", "lidarr", ChoiceError, lambda da, word: da.boxes(da.sample[0], word).frame),
    (
        "camera_back",
        "Camera_Back",
        "Camera_Bck",
        ChoiceError,
        lambda da, word: da.boxes(da.sample[0], word).frame,
    ),
    (
        "Camera",
        "camera",
        "camra",
        ChoiceError,
        lambda da, word: repr(da.boxes(da.sample[0], visible=word)),
    ),
    (
        "DERIVED",
        "derived",
        "derive",
        ChoiceError,
        lambda da, word: repr(da.boxes(da.sample[0], velocity=word)),
    ),
    (
        "RELEASED",
        "released",
        "relased",
        ChoiceError,
        lambda da, w: repr(da.cooperative_boxes(da.sample[0], visible=w)),
    ),
    (
        "LIDAR01",
        "lidar01",
        "lidar1",
        TokenError,
        lambda da, word: da.get_sample_data_path(da.sample[0], word),
    ),
    (
        "Ego_Vehicle",
        "ego_vehicle",
        "ego",
        TokenError,
        lambda da, word: da.get_sample(da.scenario[0], word, 1),
    ),
    ("Val", "val", "vall", ChoiceError, lambda da, word: da.split_scenarios(word)),
    ("Train", "train", "trian", ChoiceError, lambda da, word: da.samples("train", word)),
    (
        "+Behind",
        "+behind",
        "+behnd",
        ChoiceError,
        lambda da, word: cooperating_agents(da, da.sample[0], word),
    ),
    (
        "Available",
        "available",
        "availible",
        ChoiceError,
        lambda da, word: cooperating_agents(da, da.sample[0], word),
    ),
    (
        "EGO_VEHICLE",
        "ego_vehicle",
        "ego",
        ChoiceError,
        lambda da, word: cooperating_agents(da, da.sample[0], [word]),
    ),
    ("Sample_Data", "sample_data", "sampledata", TableError, lambda da, word: len(da.arrow(word))),
    (
        "V1",
        "v1",
        "v1.0-trainval",
        VersionError,
        lambda da, word: find_release(da.dataroot, word).version,
    ),
]
"""A word in another case, as it is known, a wrong one, its error and a call that takes it."""
MAKERS: list[tuple[str, str, str, type[DeepAccidentError], Callable[[str], Any]]] = [
    ("FIERY", "fiery", "firy", ChoiceError, lambda word: BevGrid(orientation=word)),
    ("Fiery", "fiery", "fire", ChoiceError, MotionLabelConfig.preset),
    ("ALL", "all", "al", ChoiceError, lambda word: MotionLabelConfig(agents=word)),
    ("Clean", "clean", "cleen", ChoiceError, lambda word: MotionLabelConfig(protocol=word)),
    ("Paper", "paper", "papers", ChoiceError, lambda word: MotionEvaluator(protocol=word).protocol),
    ("Boxes", "boxes", "box", ChoiceError, lambda word: AccidentEvaluator(protocol=word).protocol),
    (
        "OpenCOOD",
        "opencood",
        "open",
        ChoiceError,
        lambda word: DetectionEvaluator(protocol=word).protocol,
    ),
    (
        "Field",
        "field",
        "fields",
        ChoiceError,
        lambda word: WarningEvaluator(protocol=word).protocol,
    ),
    ("Motion", "motion", "motoin", ChoiceError, lambda word: EvaluationSetup(task=word)),
    (
        "Accident",
        "accident",
        "acident",
        ChoiceError,
        lambda word: SampleSelection(split="val", scope=word),
    ),
    ("Lidar01", "lidar01", "lidar", ChoiceError, lambda word: McapConfig(channels=[word])),
    ("Boxes", "boxes", "box", ChoiceError, lambda word: layers_of([word], ())),
    ("Other", "other", "othr", ChoiceError, lambda word: AgentConfig("mine", (word,))),
    ("Hidden", "hidden", "hiden", ConfigError, lambda word: SynthConfig(view=word)),
    ("INFRASTRUCTURE", "infrastructure", "infra", ConfigError, lambda w: SmallRelease(agents=(w,))),
    ("BEVerse", "beverse", "bevers", ChoiceError, lambda word: config_from_names(SETTINGS, word)),
    (
        "DeepAccident",
        "deepaccident",
        "accident",
        ChoiceError,
        lambda word: config_from_names(SETTINGS, word),
    ),
    (
        "Bilinear",
        "bilinear",
        "linear",
        ChoiceError,
        warp_dtype,
    ),
    (
        "Constant_Turn_Rate",
        "constant_turn_rate",
        "constant_turn",
        ChoiceError,
        lambda word: Baseline(model=word),
    ),
    ("Infrastructure", "infrastructure", "infra", ChoiceError, lambda word: agent_names((word,))),
    ("VEHICLES", "vehicles", "vehicle", ChoiceError, lambda word: names_or_configuration((word,))),
]


@pytest.mark.parametrize(
    ("word", "known_word", "wrong_word", "error", "call"),
    [
        *CALLS,
        *((*words, error, lambda _, word, make=make: make(word)) for *words, error, make in MAKERS),
    ],
)
def test_a_word_is_taken_in_any_case(
    da: DeepAccident,
    word: str,
    known_word: str,
    wrong_word: str,
    error: type[DeepAccidentError],
    call: Callable[..., Any],
) -> None:
    assert call(da, word) == call(da, known_word)
    assert_raises((lambda: call(da, wrong_word), error, r"; did you mean '[\w+-]+'\?$"))


def test_every_option_with_words_takes_them_in_any_case() -> None:
    context = click.Context(deepaccident)
    options = []
    for _, verb in walk_commands(deepaccident):
        options += [(verb, option) for option in verb.params]
    word_options = [pair for pair in options if isinstance(pair[1].type, click.Choice)]

    assert len(word_options) > 40
    for verb, option in word_options:
        assert isinstance(option.type, WordChoice), f"{verb.name} {option.opts[0]}"
        for word in option.type.choices:
            assert option.type.convert(word.upper(), option, context) == word


@pytest.mark.parametrize("word", ["qqq", None, 3, ["left"]])
def test_a_word_unlike_any_known_word_has_no_suggestion(word: Any) -> None:
    splits = ("train", "val", "test")
    assert meant_text("validation", splits) == "; did you mean 'val'?"
    assert meant_text("training", splits) == "; did you mean 'train'?"
    assert meant_text("Testing", splits) == "; did you mean 'test'?"
    assert meant_text("qqq", ["left", "right"]) == ""
    assert meant_text("", ["left"]) == ""
    assert meant_text(None, ["left"]) == ""
    assert_raises(
        (
            lambda: choice("turn", word, ("left", "right")),
            ChoiceError,
            r"^turn: expected one of left, right, found .*[^?]$",
        ),
        (
            lambda: choice("turn", 3, (None, "left")),
            ChoiceError,
            r"expected one of left, or None, found 3$",
        ),
    )
    assert choice("turn", None, (None, "left")) is None


def test_differing_settings_are_listed_with_both_values() -> None:
    stored = {"agents": ["ego"], "training": {"steps": 2, "rate": 0.1}, "old": 1}
    message = differing_text(stored, {"agents": ("ego",), "training": {"steps": 3, "rate": 0.1}})

    assert message == "old: 1, asked for None; training/steps: 2, asked for 3"
    assert differing_text(stored, stored) == ""
    long_message = differing_text({}, dict.fromkeys("abcde", 1))
    assert long_message.endswith("c: None, asked for 1; and 2 more")


def test_a_word_that_has_a_meaning_elsewhere_is_explained() -> None:
    explanations = {"left": "; that is a side"}
    assert_raises(
        (
            lambda: choice("way", "LEFT", ("on", "off"), elsewhere=explanations),
            ChoiceError,
            ("a side",),
        )
    )


@pytest.mark.parametrize(
    ("paths", "expected"),
    [
        (["runs/single/accident", "runs/five/accident"], ["single", "five"]),
        (["a", "b/c"], ["a", "c"]),
        (["x/a/motion", "y/a/motion", "x/b/motion"], ["x/a/motion", "y/a/motion", "x/b/motion"]),
        (["runs/one", "runs/one"], ["runs/one", "runs/one"]),
    ],
    ids=["tasks", "folders", "two parts", "same"],
)
def test_evaluations_are_named_by_the_part_that_differs(
    paths: list[str], expected: list[str]
) -> None:
    assert distinct_names(paths) == expected
