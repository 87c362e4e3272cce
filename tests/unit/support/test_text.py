"""Words that the devkit knows are taken in any case of letters; of another word, the error says
which was meant.
"""

from collections.abc import Callable
from typing import Any

import click
import numpy as np
import pytest
from refusals import assert_refused
from verbs import commands

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
from deepaccident_devkit.support.text import choice, differing_text, meant_text
from deepaccident_devkit.testing import SmallRelease
from deepaccident_devkit.v2x import AgentConfig, cooperating_agents

SETTINGS = {"grid_conf": {"xbound": (-50.0, 50.0, 0.5), "ybound": (-30.0, 50.0, 0.5)}}


def warped(mode: str) -> np.ndarray:
    return agents_to_ego(np.zeros((2, 200, 200), dtype=np.int16), np.zeros((2, 6)), mode=mode)


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
"""A word in another case, as it is known, a wrong one, its error, and a call."""
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
        lambda word: warped(word).dtype,
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
    ("given", "known", "wrong", "error", "call"),
    [
        *CALLS,
        *((*words, error, lambda _, word, make=make: make(word)) for *words, error, make in MAKERS),
    ],
)
def test_a_word_is_taken_in_any_case(
    da: DeepAccident,
    given: str,
    known: str,
    wrong: str,
    error: type[DeepAccidentError],
    call: Callable[..., Any],
) -> None:
    assert call(da, given) == call(da, known)
    assert_refused((lambda: call(da, wrong), error, r"; did you mean '[\w+-]+'\?$"))


def test_every_option_with_words_takes_them_in_any_case() -> None:
    context = click.Context(deepaccident)
    options = [(verb, option) for _, verb in commands(deepaccident) for option in verb.params]
    of_words = [(verb, option) for verb, option in options if isinstance(option.type, click.Choice)]
    assert len(of_words) > 40
    for verb, option in of_words:
        assert isinstance(option.type, WordChoice), f"{verb.name} {option.opts[0]}"
        words = list(option.type.choices)
        assert [option.type.convert(word.upper(), option, context) for word in words] == words


@pytest.mark.parametrize("wrong", ["qqq", None, 3, ["left"]])
def test_a_word_that_is_like_none_has_no_suggestion(wrong: Any) -> None:
    splits = ("train", "val", "test")
    meant = [meant_text(wrong, splits) for wrong in ("validation", "training", "Testing")]
    assert meant == [f"; did you mean {split!r}?" for split in ("val", "train", "test")]
    assert (
        meant_text("qqq", ["left", "right"])
        == meant_text("", ["left"])
        == meant_text(None, ["left"])
        == ""
    )
    told = r"^turn: expected one of left, right, found .*[^?]$"
    assert_refused(
        (lambda: choice("turn", wrong, ("left", "right")), ChoiceError, told),
        (
            lambda: choice("turn", 3, (None, "left")),
            ChoiceError,
            r"expected one of left, or None, found 3$",
        ),
    )
    assert choice("turn", None, (None, "left")) is None


def test_what_differs_is_told_with_both_values() -> None:
    there = {"agents": ["ego"], "training": {"steps": 2, "rate": 0.1}, "old": 1}
    asked = {"agents": ("ego",), "training": {"steps": 3, "rate": 0.1}}
    assert differing_text(there, asked) == "old: 1, asked for None; training/steps: 2, asked for 3"
    assert differing_text(there, there) == ""
    assert differing_text({}, dict.fromkeys("abcde", 1)).endswith(
        "c: None, asked for 1; and 2 more"
    )


def test_a_word_that_means_something_elsewhere_is_told_so() -> None:
    elsewhere = {"left": "; that is a side"}
    assert_refused(
        (
            lambda: choice("way", "LEFT", ("on", "off"), elsewhere=elsewhere),
            ChoiceError,
            ("a side",),
        )
    )
