"""What questions show and what their truth says, against the tables; whom they leave out, and how
files come about.
"""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from hypothesis import given
from hypothesis import strategies as st
from question_files import Asked, accident_of, ask
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.export.frames import keyframes
from deepaccident_devkit.export.questions import Questions, WindowRules
from deepaccident_devkit.export.questions.questions import seconds_ahead
from deepaccident_devkit.release import read_meta
from deepaccident_devkit.release.meta import write_meta
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x.cooperation import visible_instances

pytestmark = pytest.mark.slow

WINDOW = WindowRules(observe=1.0, stride=0.5)
SET = ("ego_vehicle", "other_vehicle", "infrastructure")
FORM = Questions(observers=SET, window=WINDOW, agents=("ego_vehicle", "infrastructure"))
NAMES = {"ego", "partner_1", "partner_2", "infrastructure"}


@pytest.fixture(scope="module")
def asked(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Asked:
    return ask(da_motion, tmp_path_factory.mktemp("questions"), FORM)


def verb(*words: object) -> Result:
    return CliRunner().invoke(deepaccident, list(map(str, words)), catch_exceptions=False)


def frames_of(sample: str, question: dict[str, Any]) -> list[int]:
    return [int(sample[-3:]) + round(10 * time) for time in question["moments"]]


def test_every_window_of_every_ego_is_asked_about(da_motion: DeepAccident, asked: Asked) -> None:
    wanted = {
        f"{scenario['token']}/{ego}/{present:03d}"
        for scenario in da_motion.scenario
        for ego in FORM.agents
        for present in (15, 20, 25, 30)
    }
    assert (set(asked.lines), asked.done.tally.samples) == (wanted, len(wanted))
    assert not asked.done.tally.left_out


def test_the_actors_of_each_moment_are_those_that_the_set_sees(
    da_motion: DeepAccident, asked: Asked
) -> None:
    for sample in asked.lines:
        question, truth = asked.question(sample), asked.truth[sample]
        scenario, ego, _ = sample.rsplit("/", 2)
        assert set(truth["observers"]) == {each["name"] for each in question["observers"]} <= NAMES
        assert truth["observers"]["ego"] == ego
        members = {da_motion.agent.get(f"{scenario}/{agent}")["actor_id"] for agent in SET}
        for frame, time in zip(frames_of(sample, question), question["moments"], strict=True):
            for name, agent in truth["observers"].items():
                by_it = {
                    truth["actors"][actor["name"]]
                    for actor in question["actors"]
                    if time in actor["time"] and name in actor["seen_by"][actor["time"].index(time)]
                }
                tokens = visible_instances(
                    da_motion, f"{scenario}/{agent}/{frame:03d}", agents=[agent]
                )
                assert by_it == {int(token.rsplit("/", 1)[1]) for token in tokens} - members


def test_places_headings_speeds_and_sizes_are_those_of_the_labels(
    da_motion: DeepAccident, asked: Asked
) -> None:
    for sample in list(asked.lines)[:6]:
        question, truth = asked.question(sample), asked.truth[sample]
        scenario = sample.rsplit("/", 2)[0]
        ego_from_world = da_motion.world_from(sample, "ego").inverse()
        agents = {name: f"{scenario}/{agent}" for name, agent in truth["observers"].items()}
        for actor in question["actors"]:
            assert actor["time"] == sorted(set(actor["time"]))
            for number, time in enumerate(actor["time"]):
                token = f"{agents[actor['seen_by'][number][0]]}/{int(sample[-3:]) + round(10 * time):03d}"  # noqa: E501
                boxes = da_motion.boxes(token, velocity="label").transform(ego_from_world, "ego")
                row = np.flatnonzero(boxes.actor_id == truth["actors"][actor["name"]]).item()
                assert actor["position"][number] == pytest.approx(
                    boxes.center[row, :2].tolist(), abs=0.011
                )
                turn = actor["heading"][number] - boxes.yaw[row]
                assert np.arctan2(np.sin(turn), np.cos(turn)) == pytest.approx(0, abs=0.002)
                assert actor["speed"][number] == pytest.approx(
                    np.linalg.norm(boxes.velocity[row]), abs=0.006
                )
                size = pytest.approx(boxes.size[row].tolist(), abs=0.006)
                assert (actor["class"], actor["size"]) == (boxes.category_names[row], size)


def test_observers_know_themselves(da_motion: DeepAccident, asked: Asked) -> None:
    for sample in list(asked.lines)[:6]:
        question, truth = asked.question(sample), asked.truth[sample]
        scenario = sample.rsplit("/", 2)[0]
        ego_from_world = da_motion.world_from(sample, "ego").inverse()
        for observer in question["observers"]:
            agent = truth["observers"][observer["name"]]
            for number, frame in enumerate(frames_of(sample, question)):
                token = f"{scenario}/{agent}/{frame:03d}"
                pose = ego_from_world @ da_motion.world_from(token, "ego")
                assert observer["position"][number] == pytest.approx(
                    pose.translation[:2].tolist(), abs=0.006
                )
                assert observer["heading"][number] == pytest.approx(pose.yaw, abs=0.001)
            record = da_motion.agent.get(f"{scenario}/{agent}")
            assert truth["actors"].get(observer["name"]) == record["actor_id"]
        assert question["observers"][0]["position"][-1] == [0, 0]


def test_names_go_by_what_was_seen_alone(asked: Asked) -> None:
    for sample in asked.lines:
        question = asked.question(sample)
        assert [actor["name"] for actor in question["actors"]] == [
            f"a{number}" for number in range(1, len(question["actors"]) + 1)
        ]
        apart = [
            np.hypot(*each["position"][-1])
            for each in question["observers"]
            if "partner" in each["name"]
        ]
        assert apart == sorted(apart)


def test_the_truth_of_an_accident(da_motion: DeepAccident, asked: Asked) -> None:
    scenario = accident_of(da_motion)
    contact = da_motion.collision(scenario)
    for sample, truth in asked.truth.items():
        if not sample.startswith(scenario):
            whole = (35 - int(sample[-3:])) // 10
            assert truth["accident"] == [False] * whole + [None] * (3 - whole)
            assert (truth["who"], truth["where"], truth["when"], truth["why"]) == (
                None,
                None,
                None,
                None,
            )
            continue
        seconds = (35 - int(sample[-3:])) / 10
        assert truth["accident"] == ([True, None, None] if seconds <= 1 else [False, True, None])
        assert (truth["when"], truth["last_frame"], truth["actor_ids"]) == (
            seconds,
            35,
            list(contact.actor_ids),
        )
        impact = da_motion.world_from(sample, "ego").inverse()
        boxes = da_motion.boxes(f"{scenario}/ego_vehicle/035").transform(impact, "ego")
        ids = da_motion.actor_ids(f"{scenario}/ego_vehicle/035")
        for actor, place in zip(truth["actor_ids"], truth["where"], strict=True):
            assert place == pytest.approx(
                boxes.center[ids == actor][0, :2].tolist(), abs=0.4
            )  # own rows are off
        assert [
            truth["actors"].get(name, actor)
            for name, actor in zip(truth["who"], contact.actor_ids, strict=True)
        ] == [*contact.actor_ids]
        assert truth["why"]["impact_angle"] == pytest.approx(contact.impact_angle, abs=0.006)
        assert truth["why"]["sides"] == list(contact.sides)
        assert truth["why"]["ego_direction"] == da_motion.scenario.get(scenario)["ego_direction"]


def test_when_the_colliders_were_last_seen(da_motion: DeepAccident, tmp_path: Path) -> None:
    found = ask(da_motion, tmp_path, Questions(window=replace(WINDOW, observe=0), agents=AGENTS))
    told = set()
    for sample, truth in found.truth.items():
        shown = {each["name"]: each["time"][-1] for each in found.question(sample)["actors"]}
        for name, last in zip(truth["who"] or [], truth["last_seen"] or [], strict=True):
            assert last == (None if name is None else 0 if name == "ego" else shown[name])
            told.add("ego" if name == "ego" else "hidden" if name is None else "seen")
    assert told == {"ego", "hidden", "seen"}


@pytest.mark.parametrize(
    ("accident", "frames", "seconds", "expected"),
    [
        (10, 10, 3, [True, None, None]),
        (11, 11, 3, [False, True, None]),
        (30, 30, 3, [False, False, True]),
        (31, 31, 3, [False, False, False]),
        (1, 1, 1, [True]),
        (None, 9, 2, [None, None]),
        (None, 10, 2, [False, None]),
        (None, 25, 3, [False, False, None]),
    ],
)
def test_the_seconds_of_an_accident(
    accident: int | None, frames: int, seconds: int, expected: list[bool | None]
) -> None:
    assert seconds_ahead(accident, frames, seconds) == expected


def without(folder: str) -> Callable[[Path, str], None]:
    def remove(root: Path, scenario: str) -> None:
        kind, name = scenario.split("/")
        for path in root.glob(f"{kind}/{folder}"):
            shutil.rmtree(path / name) if (path / name).is_dir() else (
                path / f"{name}.txt"
            ).unlink()

    return remove


def naming_a_stranger(root: Path, scenario: str) -> None:
    kind, name = scenario.split("/")
    path = root / kind / "meta" / f"{name}.txt"
    meta = read_meta(path)
    assert meta.collision is not None
    write_meta(
        path, replace(meta, collision=replace(meta.collision, ids=(meta.collision.ids[0], 999_999)))
    )


@pytest.mark.parametrize(
    ("change", "form", "said"),
    [
        (
            naming_a_stranger,
            FORM,
            {"scenarios with an actor in the accident that no label shows": 1},
        ),
        (
            without("meta"),
            FORM,
            {"scenarios without meta, which says whether there is an accident": 1},
        ),
        (without("*/label"), FORM, {"scenarios without labels": 1}),
        (
            without("other_vehicle/label"),
            FORM,
            {"windows with a moment at which an observer has no label": 8},
        ),
        (
            without("other_vehicle/*"),
            FORM,
            {"recordings whose observers are not all in this release": 2},
        ),
        (
            without("ego_vehicle/*"),
            replace(FORM, observers="single"),
            {"agents of scenarios that are not in this release": 1},
        ),
    ],
)
def test_what_cannot_be_asked_is_counted(
    da_motion: DeepAccident,
    tmp_path: Path,
    change: Callable[[Path, str], None],
    form: Questions,
    said: dict[str, int],
) -> None:
    root = tmp_path / "release"
    shutil.copytree(da_motion.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident"))
    change(root, accident_of(da_motion))
    found = ask(DeepAccident(dataroot=root, verbose=False, workers=1), tmp_path, form)
    assert dict(found.done.tally.left_out) == said
    assert len({sample.rsplit("/", 2)[0] for sample in found.lines} - {accident_of(da_motion)}) == 1


def test_a_release_in_which_nothing_can_be_asked(
    da_motion: DeepAccident, da_b: DeepAccident, tmp_path: Path
) -> None:
    root = tmp_path / "release"
    shutil.copytree(
        da_motion.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident", "meta")
    )
    without_meta, short = (
        DeepAccident(dataroot=root, verbose=False, workers=1),
        WindowRules(observe=0, stride=0.5),
    )
    assert_refused(
        (
            lambda: ask(without_meta, tmp_path, FORM),
            NotAvailableError,
            "^no question can be asked: scenarios lack labels",
        ),
        (
            lambda: ask(da_b, tmp_path, Questions(window=short)),
            NotAvailableError,
            ("no recording is long", "has 0.4"),
        ),
    )


def test_the_command(da_motion: DeepAccident, asked: Asked, tmp_path: Path) -> None:
    words = [
        "--agents",
        ",".join(SET),
        "--ego",
        "ego_vehicle,infrastructure",
        "--observe",
        1,
        "--stride",
        0.5,
    ]
    result = verb(
        "export", "questions", da_motion.dataroot, "--out", tmp_path / "out", "--workers", 1, *words
    )
    assert result.exit_code == 0, result.output
    for name in ("questions/questions.jsonl", "truth.jsonl"):
        assert (tmp_path / "out" / name).read_bytes() == (asked.done.folder / name).read_bytes()
    refused = verb(
        "export",
        "questions",
        da_motion.dataroot,
        "--out",
        tmp_path / "out",
        "--channels",
        "Camera_Back",
    )
    assert (refused.exit_code, "--channels changes nothing without --images" in refused.stderr) == (
        2,
        True,
    )


def test_the_command_with_pictures(da: DeepAccident, tmp_path: Path) -> None:
    words = [
        "--observe",
        0,
        "--stride",
        0.5,
        "--images",
        "copy",
        "--channels",
        "all",
        "--seed",
        "a b",
    ]
    verb("export", "questions", da.dataroot, "--out", tmp_path / "out", "--workers", 1, *words)
    told = json.loads((tmp_path / "out" / "questions.manifest.json").read_text())
    assert (told["written"]["linked"], told["settings"]["seed"]) == ({"copy": 4 * 6}, "a b")


@pytest.mark.parametrize(
    ("rules", "last", "presents"),
    [
        (WindowRules(observe=2.0), 57, [27, 37, 47]),
        (WindowRules(observe=2.0, stride=0.5), 40, [25, 30, 35]),
        (WindowRules(observe=2.0, stride=0.5), 41, [21, 26, 31, 36]),
        (WindowRules(observe=5.0), 51, []),
    ],
)
def test_presents_are_counted_back_from_the_last_frame_which_is_none(
    rules: WindowRules, last: int, presents: list[int]
) -> None:
    assert [each.present for each in rules.windows(last)] == presents


@given(st.integers(0, 130), st.integers(0, 12), st.integers(1, 6))
def test_windows_lie_in_the_recording_before_its_end(last: int, observe: int, stride: int) -> None:
    windows = WindowRules(observe=observe, stride=stride / 2).windows(last)
    for window in windows:
        assert 1 <= window.frames[0] <= window.present < last
        assert window.present in keyframes(last)  # where evaluations have their samples
        assert len(window.frames) == observe * 2 + 1
        assert set(map(int.__sub__, window.frames[1:], window.frames)) <= {5}
    assert len({window.present for window in windows}) == len(windows)
