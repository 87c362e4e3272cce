"""Compare questions and their truth with the tables, and check which scenarios they leave out."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.command_calls import invoke_command
from support.expected_errors import assert_raises
from support.question_files import QuestionFiles, accident_scenario, export_and_read

from deepaccident_devkit import DeepAccident
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
OBSERVERS = ("ego_vehicle", "other_vehicle", "infrastructure")
FORM = Questions(observers=OBSERVERS, window=WINDOW, agents=("ego_vehicle", "infrastructure"))
OBSERVER_NAMES = {"ego", "partner_1", "partner_2", "infrastructure"}


@pytest.fixture(scope="module")
def questions(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> QuestionFiles:
    return export_and_read(da_motion, tmp_path_factory.mktemp("questions"), FORM)


def frame_at(sample: str, time_s: float) -> int:
    """Return the number of the frame at a time relative to the sample."""
    return int(sample[-3:]) + round(10 * time_s)


def test_every_window_of_every_ego_is_asked_about(
    da_motion: DeepAccident, questions: QuestionFiles
) -> None:
    expected = set()
    for scenario, ego in product(da_motion.scenario, FORM.agents):
        expected |= {f"{scenario['token']}/{ego}/{present:03d}" for present in (15, 20, 25, 30)}
    assert set(questions.lines) == expected
    assert questions.done.tally.samples == len(expected)
    assert not questions.done.tally.left_out


def test_the_actors_of_each_moment_are_those_that_the_observers_see(
    da_motion: DeepAccident, questions: QuestionFiles
) -> None:
    for sample in questions.lines:
        question = questions.question(sample)
        truth = questions.truth[sample]
        scenario, ego, _ = sample.rsplit("/", 2)
        names = {observer["name"] for observer in question["observers"]}

        assert set(truth["observers"]) == names <= OBSERVER_NAMES
        assert truth["observers"]["ego"] == ego

        own_ids = {da_motion.agent.get(f"{scenario}/{agent}")["actor_id"] for agent in OBSERVERS}
        for time_s, (name, agent) in product(question["moments"], truth["observers"].items()):
            seen_ids = set()
            for actor in question["actors"]:
                seen_by = dict(zip(actor["time"], actor["seen_by"], strict=True))
                if name in seen_by.get(time_s, ()):
                    seen_ids.add(truth["actors"][actor["name"]])
            token = f"{scenario}/{agent}/{frame_at(sample, time_s):03d}"
            visible = visible_instances(da_motion, token, agents=[agent])
            visible_ids = {int(instance.rsplit("/", 1)[1]) for instance in visible}
            assert seen_ids == visible_ids - own_ids


def test_positions_headings_speeds_and_sizes_equal_the_labels(
    da_motion: DeepAccident, questions: QuestionFiles
) -> None:
    for sample in list(questions.lines)[:6]:
        question = questions.question(sample)
        truth = questions.truth[sample]
        scenario = sample.rsplit("/", 2)[0]
        ego_from_world = da_motion.world_from(sample, "ego").inverse()
        for actor in question["actors"]:
            times_s = actor["time"]
            assert times_s == sorted(set(times_s))

            for moment, time_s in enumerate(times_s):
                agent = truth["observers"][actor["seen_by"][moment][0]]
                token = f"{scenario}/{agent}/{frame_at(sample, time_s):03d}"
                boxes = da_motion.boxes(token, velocity="label").transform(ego_from_world, "ego")
                row = np.flatnonzero(boxes.actor_id == truth["actors"][actor["name"]]).item()
                position = boxes.center[row, :2].tolist()
                assert actor["position"][moment] == pytest.approx(position, abs=0.011)

                turn = actor["heading"][moment] - boxes.yaw[row]
                assert np.arctan2(np.sin(turn), np.cos(turn)) == pytest.approx(0, abs=0.002)

                speed = np.linalg.norm(boxes.velocity[row])
                assert actor["speed"][moment] == pytest.approx(speed, abs=0.006)
                assert actor["size"] == pytest.approx(boxes.size[row].tolist(), abs=0.006)
                assert actor["class"] == boxes.category_names[row]


def test_observers_know_themselves(da_motion: DeepAccident, questions: QuestionFiles) -> None:
    for sample in list(questions.lines)[:6]:
        question = questions.question(sample)
        truth = questions.truth[sample]
        scenario = sample.rsplit("/", 2)[0]
        ego_from_world = da_motion.world_from(sample, "ego").inverse()
        for observer in question["observers"]:
            agent = truth["observers"][observer["name"]]
            for moment, time_s in enumerate(question["moments"]):
                token = f"{scenario}/{agent}/{frame_at(sample, time_s):03d}"
                pose = ego_from_world @ da_motion.world_from(token, "ego")
                position = pose.translation[:2].tolist()
                assert observer["position"][moment] == pytest.approx(position, abs=0.006)
                assert observer["heading"][moment] == pytest.approx(pose.yaw, abs=0.001)
            record = da_motion.agent.get(f"{scenario}/{agent}")
            assert truth["actors"].get(observer["name"]) == record["actor_id"]

        assert question["observers"][0]["position"][-1] == [0, 0]


def test_names_follow_only_what_was_seen(questions: QuestionFiles) -> None:
    for sample in questions.lines:
        question = questions.question(sample)
        for number, actor in enumerate(question["actors"], start=1):
            assert actor["name"] == f"a{number}"
        partners = [row for row in question["observers"] if "partner" in row["name"]]
        distances_m = [np.hypot(*partner["position"][-1]) for partner in partners]
        assert distances_m == sorted(distances_m)


def test_the_truth_of_an_accident(da_motion: DeepAccident, questions: QuestionFiles) -> None:
    scenario = accident_scenario(da_motion)
    impact_sample = f"{scenario}/ego_vehicle/035"
    collision = da_motion.collision(scenario)
    for sample, truth in questions.truth.items():
        num_frames = 35 - int(sample[-3:])
        if not sample.startswith(scenario):
            whole_seconds = num_frames // 10
            assert truth["accident"] == [False] * whole_seconds + [None] * (3 - whole_seconds)
            assert {truth[name] for name in ("who", "where", "when", "why")} == {None}
            continue

        time_s = num_frames / 10

        assert truth["accident"] == ([True, None, None] if time_s <= 1 else [False, True, None])
        assert (truth["when"], truth["last_frame"]) == (time_s, 35)
        assert truth["actor_ids"] == list(collision.actor_ids)

        ego_from_world = da_motion.world_from(sample, "ego").inverse()
        boxes = da_motion.boxes(impact_sample).transform(ego_from_world, "ego")
        actor_ids = da_motion.actor_ids(impact_sample)
        colliders = zip(
            truth["actor_ids"],
            truth["who"],
            truth["where"],
            strict=True,
        )
        for actor, name, position in colliders:
            expected = boxes.center[actor_ids == actor][0, :2].tolist()
            assert position == pytest.approx(expected, abs=0.4)  # own rows are inexact
            assert truth["actors"].get(name, actor) == actor

        assert truth["why"]["impact_angle"] == pytest.approx(collision.impact_angle, abs=0.006)
        assert truth["why"]["sides"] == list(collision.sides)
        assert truth["why"]["ego_direction"] == da_motion.scenario.get(scenario)["ego_direction"]


def test_when_the_colliders_were_last_seen(da_motion: DeepAccident, tmp_path: Path) -> None:
    questions = export_and_read(
        da_motion, tmp_path, Questions(window=replace(WINDOW, observe=0), agents=AGENTS)
    )
    kinds = set()
    for sample, truth in questions.truth.items():
        actors = questions.question(sample)["actors"]
        last_times_s = {"ego": 0, None: None}
        last_times_s |= {actor["name"]: actor["time"][-1] for actor in actors}
        for name, last_seen in zip(truth["who"] or [], truth["last_seen"] or [], strict=True):
            assert last_seen == last_times_s[name]
            kinds.add(name if name in ("ego", None) else "another actor")

    assert kinds == {"ego", None, "another actor"}


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
def test_the_seconds_ahead_hold_the_accident(
    accident: int | None, frames: int, seconds: int, expected: list[bool | None]
) -> None:
    assert seconds_ahead(accident, frames, seconds) == expected


def remove_folder(pattern: str) -> Callable[[Path, str], None]:
    """Return a change that removes a scenario's folder, or its text file, from some folders."""

    def remove(root: Path, scenario: str) -> None:
        kind, name = scenario.split("/")
        for folder in root.glob(f"{kind}/{pattern}"):
            if (folder / name).is_dir():
                shutil.rmtree(folder / name)
            else:
                (folder / f"{name}.txt").unlink()

    return remove


def name_unknown_collider(root: Path, scenario: str) -> None:
    kind, name = scenario.split("/")
    path = root / kind / "meta" / f"{name}.txt"
    meta = read_meta(path)
    assert meta.collision is not None
    collision = replace(meta.collision, ids=(meta.collision.ids[0], 999_999))
    write_meta(path, replace(meta, collision=collision))


@pytest.mark.parametrize(
    ("change", "form", "left_out"),
    [
        (
            name_unknown_collider,
            FORM,
            {"scenarios with an actor in the accident that no label shows": 1},
        ),
        (
            remove_folder("meta"),
            FORM,
            {"scenarios without meta, which says whether there is an accident": 1},
        ),
        (remove_folder("*/label"), FORM, {"scenarios without labels": 1}),
        (
            remove_folder("other_vehicle/label"),
            FORM,
            {"windows with a moment at which an observer has no label": 8},
        ),
        (
            remove_folder("other_vehicle/*"),
            FORM,
            {"recordings whose observers are not all in this release": 2},
        ),
        (
            remove_folder("ego_vehicle/*"),
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
    left_out: dict[str, int],
) -> None:
    root = tmp_path / "release"
    shutil.copytree(da_motion.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident"))
    accident = accident_scenario(da_motion)
    change(root, accident)
    dataset = DeepAccident(dataroot=root, verbose=False, workers=1)
    questions = export_and_read(dataset, tmp_path, form)

    assert dict(questions.done.tally.left_out) == left_out

    scenarios = {sample.rsplit("/", 2)[0] for sample in questions.lines}
    assert len(scenarios - {accident}) == 1


def test_a_release_without_any_question_is_refused(
    da_motion: DeepAccident, da_b: DeepAccident, tmp_path: Path
) -> None:
    root = tmp_path / "release"
    shutil.copytree(
        da_motion.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident", "meta")
    )
    without_meta = DeepAccident(dataroot=root, verbose=False, workers=1)
    short_window = WindowRules(observe=0, stride=0.5)

    assert_raises(
        (
            lambda: export_and_read(without_meta, tmp_path, FORM),
            NotAvailableError,
            "^no question can be asked: scenarios lack labels",
        ),
        (
            lambda: export_and_read(da_b, tmp_path, Questions(window=short_window)),
            NotAvailableError,
            ("no recording is long", "has 0.4"),
        ),
    )


def test_the_command_writes_the_same_files(
    da_motion: DeepAccident, questions: QuestionFiles, tmp_path: Path
) -> None:
    command = ("export", "questions", da_motion.dataroot, "--out", tmp_path / "out")
    invoke_command(
        *command,
        *("--agents", ",".join(OBSERVERS), "--ego", "ego_vehicle,infrastructure"),
        *("--observe", 1, "--stride", 0.5, "--workers", 1),
    )
    for name in ("questions/questions.jsonl", "truth.jsonl"):
        expected = (questions.done.folder / name).read_bytes()
        assert (tmp_path / "out" / name).read_bytes() == expected

    refused = invoke_command(*command, "--channels", "Camera_Back", status=2)

    assert "--channels has no effect without --images" in refused.stderr


def test_the_command_copies_pictures(da: DeepAccident, tmp_path: Path) -> None:
    out = tmp_path / "out"
    invoke_command(
        *("export", "questions", da.dataroot, "--out", out),
        *("--observe", 0, "--stride", 0.5, "--images", "copy", "--channels", "all"),
        *("--seed", "a b", "--workers", 1),
    )
    manifest = json.loads((out / "questions.manifest.json").read_text())

    assert manifest["written"]["linked"] == {"copy": 4 * 6}
    assert manifest["settings"]["seed"] == "a b"


@pytest.mark.parametrize(
    ("rules", "last", "presents"),
    [
        (WindowRules(observe=2.0), 57, [27, 37, 47]),
        (WindowRules(observe=2.0, stride=0.5), 40, [25, 30, 35]),
        (WindowRules(observe=2.0, stride=0.5), 41, [21, 26, 31, 36]),
        (WindowRules(observe=5.0), 51, []),
    ],
)
def test_presents_are_counted_back_from_the_last_frame(
    rules: WindowRules, last: int, presents: list[int]
) -> None:
    assert [window.present for window in rules.windows(last)] == presents


@given(st.integers(0, 130), st.integers(0, 12), st.integers(1, 6))
def test_windows_lie_in_the_recording_before_its_end(last: int, observe: int, stride: int) -> None:
    windows = WindowRules(observe=observe, stride=stride / 2).windows(last)
    for window in windows:
        assert 1 <= window.frames[0] <= window.present < last
        assert window.present in keyframes(last)  # where evaluations have their samples
        assert len(window.frames) == observe * 2 + 1
        assert set(np.diff(window.frames)) <= {5}
    assert len({window.present for window in windows}) == len(windows)
