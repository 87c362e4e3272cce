"""The baselines: motion that is drawn, detections, and accidents that lie ahead."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import (
    ChoiceError,
    ConfigError,
    DeepAccidentError,
    NotAvailableError,
)
from deepaccident_devkit.evaluation import (
    AccidentEvaluator,
    DetectedBoxes,
    MotionEvaluator,
)
from deepaccident_devkit.evaluation.accident import accident_context
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.plugins.baselines import (
    Baseline,
    MotionModel,
    Outlook,
    SeenActors,
    detected_accidents,
    outlook,
    predict_accidents,
    predict_detections,
    predict_forecasts,
    predict_motion,
    predict_plan,
    predict_results,
    seen_actors,
)
from deepaccident_devkit.plugins.baselines.predict import accidents_ahead
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID, UNTRACKED_ID
from deepaccident_devkit.v2x import Link


@pytest.fixture(scope="session")
def tokens(da_hidden: DeepAccident) -> list[str]:
    """The ego vehicle's samples 2, 1.5, 1 and 0.5 s before the impact."""
    return [token for token in da_hidden.samples("train", "evaluate") if "/ego_vehicle/" in token]


def test_five_agents_know_the_whole_present(da_hidden: DeepAccident, tokens: list[str]) -> None:
    """All that the label shows, cell by cell; at the rim, who is beyond the ego's own label is in
    theirs.
    """
    known = []
    for token in tokens:
        label = da_hidden.motion_labels(token).instance[0, 8:-8, 8:-8] > 0
        maps = [
            predict_motion(da_hidden, token, agents=agents).instances
            for agents in ("single", "all")
        ]
        alone, together = (each[0, 0, 8:-8, 8:-8] > 0 for each in maps if each is not None)
        np.testing.assert_array_equal(together, label)
        known.append((alone & label).sum() / label.sum())
    assert min(known) < 0.8


def test_five_agents_foresee_what_one_does_not(da_hidden: DeepAccident, tokens: list[str]) -> None:
    """Not all of it: at constant velocity nobody brakes for a queue, nor turns."""
    soon = MotionLabelConfig(future_frames=1)
    for config, least in ((soon, 90), (MotionLabelConfig(), 75)):
        alone, together = MotionEvaluator(), MotionEvaluator()
        for token in tokens:
            label = da_hidden.motion_labels(token, config)
            alone.update(token, predict_motion(da_hidden, token, config=config), label)
            together.update(
                token, predict_motion(da_hidden, token, agents="all", config=config), label
            )
        score = together.compute().ranges["100x100"].pq
        assert score > least
        assert score > alone.compute().ranges["100x100"].pq + 10


@pytest.mark.parametrize("frame", ["world", "ego", "lidar"])
def test_boxes_of_a_detector_mean_the_accidents_of_those_actors(
    da_hidden: DeepAccident, tokens: list[str], frame: str
) -> None:
    """Nobody is named; unsure boxes do not count, nor those on the ego."""
    for token in tokens:
        boxes = seen_actors(
            da_hidden, token, agents="all", frame=frame
        ).boxes  # the first one is the ego
        unnamed = replace(boxes, actor_id=np.full(len(boxes), UNTRACKED_ID))
        found, unsure = (
            detected_accidents(
                da_hidden, token, DetectedBoxes(boxes=unnamed, scores=np.full(len(boxes), score))
            )
            for score in (0.5, 0.49)
        )
        named = predict_accidents(da_hidden, token, agents="all")
        assert [each.ids for each in found] == [None] * len(named)
        assert [(each.time, each.score) for each in found] == [
            (each.time, each.score) for each in named
        ]
        for each, other in zip(found, named, strict=True):
            np.testing.assert_allclose(each.positions, other.positions, atol=1e-9)
        assert unsure == []
    assert named


def test_the_hidden_accident_is_foreseen_by_the_pole_and_named(
    da_hidden: DeepAccident, tokens: list[str]
) -> None:
    collision = da_hidden.scenario[0]["collision"]
    assert collision is not None
    token = tokens[1]
    assert predict_accidents(da_hidden, token) == []
    (alarm,) = predict_accidents(da_hidden, token, agents="+infrastructure")
    assert (set(alarm.ids or ()), alarm.time) == (
        set(collision["ids"]),
        pytest.approx(1.5, abs=0.11),
    )
    evaluator = AccidentEvaluator("boxes")
    evaluator.update(token, [alarm], None, accident_context(da_hidden, token, 2.0))
    assert evaluator.compute().position_error == pytest.approx(0, abs=1.5)


def test_detections_are_the_seen_boxes_in_world(da_hidden: DeepAccident, tokens: list[str]) -> None:
    found = predict_detections(da_hidden, tokens[0], agents="all")
    seen = seen_actors(da_hidden, tokens[0], agents="all", frame="world")
    assert found.boxes.frame == "world"
    np.testing.assert_array_equal(found.boxes.center, seen.boxes.center)
    own = found.boxes.actor_id == OWN_ACTOR_ID
    np.testing.assert_array_equal(found.scores[own], [0.0])
    assert ((found.scores[~own] > 0) & (found.scores[~own] < 1)).all()
    watchers = np.array([int(bits).bit_count() for bits in seen.seen_by])
    assert (
        np.diff(watchers[~own][np.argsort(found.scores[~own])]) >= 0
    ).all()  # who is seen by more is surer


@pytest.mark.parametrize(
    ("options", "error", "sentence"),
    [
        ({"model": "constant"}, ChoiceError, r"model: .*constant_velocity, .*'constant'"),
        ({"horizon": 0.0}, ConfigError, r"horizon: .*0\.0"),
        ({"danger_distance": float("nan")}, ConfigError, "danger_distance: .*nan"),
        ({"link": 0.3}, ConfigError, "link: .*Link"),
    ],
)
def test_what_cannot_be_is_refused(
    da_hidden: DeepAccident,
    tokens: list[str],
    options: dict[str, object],
    error: type[DeepAccidentError],
    sentence: str,
) -> None:
    assert_refused((lambda: predict_accidents(da_hidden, tokens[0], **options), error, sentence))  # type: ignore[arg-type]


@pytest.mark.slow
def test_results_are_the_predictions_and_the_same_bytes_with_two_workers(
    da_hidden: DeepAccident, tokens: list[str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("results")
    every = da_hidden.samples("train", "evaluate")
    chosen = Baseline(agents="+infrastructure", link=Link(latency=0.1, pose_noise=0.2), horizon=3.0)
    one = predict_results(da_hidden, "motion", every, folder / "one", chosen, workers=1)
    two = predict_results(da_hidden, "motion", every, folder / "two", chosen, workers=2)
    content = [
        {path.name: path.read_bytes() for path in root.rglob("*") if path.is_file()}
        for root in (one, two)
    ]
    assert content[0] == content[1]
    results = read_results(one)
    results.check()
    assert results.tokens == tuple(every)
    stored = results.prediction(tokens[0])
    expected = chosen.predict(da_hidden, "motion", tokens[0])
    np.testing.assert_array_equal(stored.instances, expected.instances)  # type: ignore[union-attr]


@pytest.mark.parametrize("model", ["constant_velocity", "constant_turn_rate", "standing"])
def test_forecasts_are_where_seen_actors_go(
    da_hidden: DeepAccident, tokens: list[str], model: MotionModel
) -> None:
    ahead = outlook(da_hidden, tokens[1], agents="all", model=model)
    found = predict_forecasts(da_hidden, tokens[1], agents="all", model=model, horizon=4.0)
    others = ahead.seen.boxes.actor_id != OWN_ACTOR_ID
    assert [each.actor_id for each in found] == ahead.seen.boxes.actor_id[others].tolist()
    times = np.arange(1, 9) / 2
    expected = ahead.poses(times)[:, others, :2]
    for row, each in enumerate(found):
        assert (each.times.tolist(), each.probabilities.tolist()) == (times.tolist(), [1.0])
        np.testing.assert_array_equal(each.paths, [expected[:, row]])
    assert 0 < len(predict_forecasts(da_hidden, tokens[1], model=model)) < len(found)


def test_a_plan_is_the_egos_own_path(da_hidden: DeepAccident, tokens: list[str]) -> None:
    """In straight and even driving it is the recorded one; the ego frame moves, not the box."""
    token = tokens[0]
    plan = predict_plan(da_hidden, token)
    scenario, agent, number = token.rsplit("/", 2)
    assert (plan.times.tolist(), plan.score) == ([0.5, 1.0, 1.5, 2.0, 2.5, 3.0], 1.0)
    ego_from_world = da_hidden.world_from(token, "ego").inverse()
    recorded = [
        ego_from_world
        @ da_hidden.world_from(f"{scenario}/{agent}/{int(number) + frames:03d}", "ego")
        for frames in (5, 10)
    ]
    np.testing.assert_allclose(plan.path[:2], [pose.translation[:2] for pose in recorded], atol=1.0)
    np.testing.assert_allclose(plan.yaw, 0, atol=1e-9)  # type: ignore[arg-type]
    assert not predict_plan(da_hidden, token, model="standing").path.any()
    assert len(predict_plan(da_hidden, token, horizon=5.0).times) == 10


def test_the_infrastructure_predicts_motion_but_has_no_plan(
    da_hidden: DeepAccident, tokens: list[str]
) -> None:
    pole = tokens[0].replace("ego_vehicle", "infrastructure")
    assert np.any(predict_motion(da_hidden, pole).instances)
    assert_refused(
        (lambda: predict_plan(da_hidden, pole), NotAvailableError, (pole, "no own vehicle")),
        (
            lambda: predict_plan(da_hidden, tokens[0], horizon=0.3),
            ConfigError,
            "no number of steps of 0.5 s",
        ),
        (
            lambda: predict_forecasts(da_hidden, tokens[0], horizon=np.inf),
            ConfigError,
            "no number of steps of 0.5 s",
        ),
    )


@pytest.mark.parametrize(("horizon", "steps"), [(2.0, 6), (4.0, 8)])
def test_paths_in_files_look_three_seconds_ahead_at_least(
    da_hidden: DeepAccident, tokens: list[str], tmp_path: Path, horizon: float, steps: int
) -> None:
    baseline = Baseline(model="standing", horizon=horizon)
    for task in ("planning", "forecasting"):
        results = read_results(
            predict_results(da_hidden, task, tokens, tmp_path / task, baseline, workers=1)
        )
        assert (results.task, results.meta["model"], results.meta["horizon"]) == (
            task,
            "standing",
            steps / 2,
        )
        predicted: Any = results.prediction(tokens[0])
        assert {len(each.times) for each in predicted} == {steps}


def test_a_task_or_horizon_that_is_none_is_refused(
    da_hidden: DeepAccident, tokens: list[str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    out = tmp_path_factory.mktemp("results") / "out"
    assert_refused(
        (
            lambda: predict_results(da_hidden, "warning", tokens, out),
            ChoiceError,
            (
                "task: expected one of motion, accident, detection, planning, "
                "forecasting, found 'warning'"
            ),
        ),
        (
            lambda: predict_results(da_hidden, "motion", tokens, out, Baseline(horizon=0.7)),
            ConfigError,
            r"horizon: 0.7 s is no number of steps of 0.5 s; choose 0.5, 1, 1.5, …",
        ),
    )
    assert not out.exists()


CAR = (4.0, 2.0, 1.5)


def ahead(
    *actors: tuple[int, float, float, float, float, float],
    own: int | None = 50,
    on_foot: Sequence[int] = (),
) -> Outlook:
    """Cars, or whom ids say to be on foot, by actor id, x, y, yaw, speed along x, speed along y."""
    rows: Sequence[tuple[float, ...]] = actors
    table = np.array(rows, dtype=np.float64).reshape(-1, 6)
    boxes = Boxes.from_arrays(
        np.column_stack([table[:, 1:3], np.zeros(len(table))]),
        np.tile(CAR, (len(table), 1)),
        table[:, 3],
        frame="ego",
        actor_id=table[:, 0].astype(np.int64),
        velocity=np.column_stack([table[:, 4:6], np.zeros(len(table))]),
        category=np.where(np.isin(table[:, 0], on_foot), CATEGORIES.index("pedestrian"), 0),
    )
    seen = SeenActors(boxes=boxes, seen_by=np.zeros(len(table), np.uint8), own_actor_id=own)
    return Outlook(seen=seen, turn_rate=np.zeros(len(table)))


EGO = (OWN_ACTOR_ID, 0, 0, 0, 10, 0)
CROSSING = (7, 15, -15, np.pi / 2, 0, 10)


def test_crossing_paths_collide_where_the_boxes_first_come_near() -> None:
    (alarm,) = accidents_ahead(ahead(EGO, CROSSING), 2.0)
    # at t the centres are (10 t, 0) and (15, −15 + 10 t): the boxes touch once 15 − 10 t ≤ 3
    np.testing.assert_allclose(alarm.positions, [[12, 0], [15, -3]], atol=1e-9)
    assert (alarm.time, alarm.ids, alarm.score) == (
        pytest.approx(1.2),
        (50, 7),
        pytest.approx(1 / 2.2),
    )
    (unknown,) = accidents_ahead(
        ahead(EGO, CROSSING, own=None), 2.0
    )  # meta does not say who the ego is
    assert unknown.ids is None


PARKED = [(1, 0, 20, 0, 0, 0), (2, 4.1, 20, 0, 0, 0)]
SIDE_BY_SIDE = [(3, 0, 40, 0, 5, 0), (4, 0, 42.1, 0, 5, 0)]


@pytest.mark.parametrize(
    ("actors", "horizon"),
    [((EGO, CROSSING), 1.1), ((*PARKED, *SIDE_BY_SIDE), 2.0), ((), 2.0), ((EGO,), 2.0)],
)
def test_no_alarm_beyond_the_horizon_of_those_who_come_no_nearer_and_of_nobody(
    actors: tuple[tuple[int, float, float, float, float, float], ...], horizon: float
) -> None:
    assert accidents_ahead(ahead(*actors), horizon) == []


def test_a_pass_within_the_danger_distance_is_an_alarm_of_less_weight() -> None:
    passing = (7, 20, 2.2, np.pi, -10, 0)  # on the next lane: 0.2 m between the sides
    (alarm,) = accidents_ahead(ahead(EGO, passing), 2.0)
    assert alarm.score == pytest.approx((1 - 0.2 / 0.25) / (1 + alarm.time))
    assert accidents_ahead(ahead(EGO, passing), 2.0, danger_distance=0.1) == []


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_who_drives_up_to_a_queue_brakes(yaw: float) -> None:
    """At constant velocity the follower is through the one that stands within 2 s."""
    along = np.array([np.cos(yaw), np.sin(yaw)])

    def follower(aside: float, turned: float) -> tuple[int, float, float, float, float, float]:
        place = -12 * along + aside * np.array([-along[1], along[0]])
        return 2, *place, yaw + turned, *(8 * along)

    stands = (1, 0, 0, yaw, 0, 0)
    assert accidents_ahead(ahead(stands, follower(0.5, 0.0)), 2.0) == []
    assert accidents_ahead(ahead(follower(0.5, 0.0), stands), 2.0) == []
    assert (
        len(accidents_ahead(ahead(stands, follower(1.5, 0.0)), 2.0)) == 1
    )  # it comes from the next lane
    assert len(accidents_ahead(ahead(stands, follower(0.5, 0.6)), 2.0)) == 1  # it slides


@pytest.mark.parametrize(("on_foot", "alarms"), [([], 1), ([2], 1), ([1, 2], 0)])
def test_two_pedestrians_are_in_no_danger_of_each_other(on_foot: list[int], alarms: int) -> None:
    met = [(1, 0, 0, 0, 1.5, 0), (2, 6, 0.5, np.pi, -1.5, 0)]
    assert len(accidents_ahead(ahead(*met, on_foot=on_foot), 3.0)) == alarms


def test_two_that_overlap_now_are_the_surest_alarm() -> None:
    (alarm,) = accidents_ahead(ahead((1, 0, 0, 0, 5, 0), (2, 1, 0, 0, 5, 0)), 2.0)
    assert (alarm.time, alarm.score) == (0, 1)


def test_of_alarms_at_one_place_the_surest_is_kept() -> None:
    followers = [(8, -8, 0, 0, 10, 0), (9, 15, -23, np.pi / 2, 0, 10)]
    far_away = [(10, 0, 100, 0, 10, 0), (11, 17, 85, np.pi / 2, 0, 10)]
    alarms = accidents_ahead(ahead(EGO, CROSSING, *followers, *far_away), 3.0)
    assert [alarm.ids for alarm in alarms] == [(50, 7), (10, 11)]
    assert alarms[0].score > alarms[1].score
