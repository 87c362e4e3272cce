"""The baselines: motion on a map, detections, and accidents that lie ahead."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.expected_errors import assert_raises

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
from deepaccident_devkit.evaluation.tracking import TrackingEvaluator
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
    predict_tracks,
    seen_actors,
)
from deepaccident_devkit.plugins.baselines.predict import accidents_ahead
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID, UNTRACKED_ID
from deepaccident_devkit.v2x import Link


@pytest.fixture(scope="session")
def tokens(da_hidden: DeepAccident) -> list[str]:
    """Return the ego vehicle's samples 2, 1.5, 1 and 0.5 s before the impact."""
    return [token for token in da_hidden.samples("train", "evaluate") if "/ego_vehicle/" in token]


def test_five_agents_know_the_whole_present(da_hidden: DeepAccident, tokens: list[str]) -> None:
    """Five agents know every labelled cell, except at the rim, where they also see actors beyond
    the ego's own label.
    """

    def predict_foreground(token: str, agents: str) -> np.ndarray:
        instances = predict_motion(da_hidden, token, agents=agents).instances
        assert instances is not None
        return instances[0, 0, 8:-8, 8:-8] > 0

    single_shares = []
    for token in tokens:
        label = da_hidden.motion_labels(token).instance[0, 8:-8, 8:-8] > 0
        np.testing.assert_array_equal(predict_foreground(token, "all"), label)
        known_cells = predict_foreground(token, "single") & label
        single_shares.append(known_cells.sum() / label.sum())
    assert min(single_shares) < 0.8


def test_five_agents_foresee_what_one_does_not(da_hidden: DeepAccident, tokens: list[str]) -> None:
    """Even five miss a part: at constant velocity nobody turns or brakes for a queue."""
    half_second = MotionLabelConfig(future_frames=1)
    for config, min_quality in ((half_second, 90), (MotionLabelConfig(), 75)):
        single, cooperating = MotionEvaluator(), MotionEvaluator()
        for token in tokens:
            label = da_hidden.motion_labels(token, config)
            motion = predict_motion(da_hidden, token, agents="all", config=config)
            single.update(token, predict_motion(da_hidden, token, config=config), label)
            cooperating.update(token, motion, label)
        quality = cooperating.compute().ranges["100x100"].pq
        assert quality > min_quality
        assert quality > single.compute().ranges["100x100"].pq + 10


@pytest.mark.parametrize("frame", ["world", "ego", "lidar"])
def test_boxes_of_a_detector_mean_the_accidents_of_their_actors(
    da_hidden: DeepAccident, tokens: list[str], frame: str
) -> None:
    """Accidents of detected boxes have no ids; unsure boxes and boxes on the ego do not count."""
    for token in tokens:
        boxes = seen_actors(da_hidden, token, agents="all", frame=frame).boxes  # first is the ego
        untracked = replace(boxes, actor_id=np.full(len(boxes), UNTRACKED_ID))
        sure = DetectedBoxes(boxes=untracked, scores=np.full(len(boxes), 0.5))
        unsure = DetectedBoxes(boxes=untracked, scores=np.full(len(boxes), 0.49))
        accidents = detected_accidents(da_hidden, token, sure)
        expected = predict_accidents(da_hidden, token, agents="all")
        for accident, expected_accident in zip(accidents, expected, strict=True):
            assert accident.ids is None
            assert accident.time == expected_accident.time
            assert accident.score == expected_accident.score
            np.testing.assert_allclose(accident.positions, expected_accident.positions, atol=1e-9)
        assert detected_accidents(da_hidden, token, unsure) == []
    assert expected


def test_the_infrastructure_foresees_the_hidden_accident_and_names_its_actors(
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
    detections = predict_detections(da_hidden, tokens[0], agents="all")
    seen = seen_actors(da_hidden, tokens[0], agents="all", frame="world")
    assert detections.boxes.frame == "world"
    np.testing.assert_array_equal(detections.boxes.center, seen.boxes.center)

    is_ego = detections.boxes.actor_id == OWN_ACTOR_ID
    scores = detections.scores[~is_ego]
    num_watchers = np.array([int(bits).bit_count() for bits in seen.seen_by[~is_ego]])
    np.testing.assert_array_equal(detections.scores[is_ego], [0.0])
    assert ((scores > 0) & (scores < 1)).all()
    # an actor that more agents see has a higher score
    assert (np.diff(num_watchers[np.argsort(scores)]) >= 0).all()


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"model": "constant"}, ChoiceError, r"model: .*constant_velocity, .*'constant'"),
        ({"horizon": 0.0}, ConfigError, r"horizon: .*0\.0"),
        ({"danger_distance": float("nan")}, ConfigError, "danger_distance: .*nan"),
        ({"link": 0.3}, ConfigError, "link: .*Link"),
    ],
)
def test_impossible_options_are_refused(
    da_hidden: DeepAccident,
    tokens: list[str],
    options: dict[str, object],
    error: type[DeepAccidentError],
    message: str,
) -> None:
    def predict() -> None:
        predict_accidents(da_hidden, tokens[0], **options)  # type: ignore[arg-type]

    assert_raises((predict, error, message))


@pytest.mark.slow
def test_results_are_the_predictions_and_the_same_bytes_with_two_workers(
    da_hidden: DeepAccident, tokens: list[str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("results")
    all_tokens = da_hidden.samples("train", "evaluate")
    link = Link(latency=0.1, pose_noise=0.2)
    baseline = Baseline(agents="+infrastructure", link=link, horizon=3.0)
    contents = []
    for workers in (1, 2):
        out = folder / str(workers)
        predict_results(da_hidden, "motion", all_tokens, out, baseline, workers=workers)
        files = [path for path in out.rglob("*") if path.is_file()]
        contents.append({path.name: path.read_bytes() for path in files})
    assert contents[0] == contents[1]

    results = read_results(folder / "1")
    results.check()
    assert results.tokens == tuple(all_tokens)
    prediction = results.prediction(tokens[0])
    expected = baseline.predict(da_hidden, "motion", tokens[0])
    np.testing.assert_array_equal(prediction.instances, expected.instances)  # type: ignore[union-attr]


@pytest.mark.parametrize("model", ["constant_velocity", "constant_turn_rate", "standing"])
def test_forecasts_are_where_seen_actors_go(
    da_hidden: DeepAccident, tokens: list[str], model: MotionModel
) -> None:
    token = tokens[1]
    expected_outlook = outlook(da_hidden, token, agents="all", model=model)
    forecasts = predict_forecasts(da_hidden, token, agents="all", model=model, horizon=4.0)
    actor_ids = expected_outlook.seen.boxes.actor_id
    is_other = actor_ids != OWN_ACTOR_ID
    assert [forecast.actor_id for forecast in forecasts] == actor_ids[is_other].tolist()

    times = np.arange(1, 9) / 2
    paths = expected_outlook.poses(times)[:, is_other, :2]
    for row, forecast in enumerate(forecasts):
        assert forecast.times.tolist() == times.tolist()
        assert forecast.probabilities.tolist() == [1.0]
        np.testing.assert_array_equal(forecast.paths, [paths[:, row]])
    assert 0 < len(predict_forecasts(da_hidden, token, model=model)) < len(forecasts)


def test_a_plan_is_the_egos_own_path(da_hidden: DeepAccident, tokens: list[str]) -> None:
    """When driving straight at constant speed, the plan is the recorded path."""
    token = tokens[0]
    plan = predict_plan(da_hidden, token)
    assert plan.times.tolist() == [0.5, 1.0, 1.5, 2.0, 2.5, 3.0]
    assert plan.score == 1.0

    recording, frame = token.rsplit("/", 1)
    ego_from_world = da_hidden.world_from(token, "ego").inverse()
    recorded_path = []
    for frames in (5, 10):
        later_token = f"{recording}/{int(frame) + frames:03d}"
        pose = ego_from_world @ da_hidden.world_from(later_token, "ego")
        recorded_path.append(pose.translation[:2])
    np.testing.assert_allclose(plan.path[:2], recorded_path, atol=1.0)
    np.testing.assert_allclose(plan.yaw, 0, atol=1e-9)  # type: ignore[arg-type]
    assert not predict_plan(da_hidden, token, model="standing").path.any()
    assert len(predict_plan(da_hidden, token, horizon=5.0).times) == 10


def test_the_infrastructure_predicts_motion_but_has_no_plan(
    da_hidden: DeepAccident, tokens: list[str]
) -> None:
    pole = tokens[0].replace("ego_vehicle", "infrastructure")
    assert np.any(predict_motion(da_hidden, pole).instances)
    assert_raises(
        (lambda: predict_plan(da_hidden, pole), NotAvailableError, (pole, "does not drive")),
        (
            lambda: predict_plan(da_hidden, tokens[0], horizon=0.3),
            ConfigError,
            "not a multiple of 0.5 s",
        ),
        (
            lambda: predict_forecasts(da_hidden, tokens[0], horizon=np.inf),
            ConfigError,
            "not a multiple of 0.5 s",
        ),
    )


@pytest.mark.parametrize(("horizon", "steps"), [(2.0, 6), (4.0, 8)])
def test_paths_in_files_look_three_seconds_ahead_at_least(
    da_hidden: DeepAccident, tokens: list[str], tmp_path: Path, horizon: float, steps: int
) -> None:
    baseline = Baseline(model="standing", horizon=horizon)
    for task in ("planning", "forecasting"):
        path = predict_results(da_hidden, task, tokens, tmp_path / task, baseline, workers=1)
        results = read_results(path)
        assert results.task == task
        assert results.meta["model"] == "standing"
        assert results.meta["horizon"] == steps / 2
        forecasts: Any = results.prediction(tokens[0])
        assert {len(forecast.times) for forecast in forecasts} == {steps}


def test_tracks_of_what_an_agent_sees_are_perfect_for_its_own_truth(
    da_hidden: DeepAccident, tokens: list[str]
) -> None:
    evaluator = TrackingEvaluator(truth="own")
    for token in tokens:
        truth = evaluator.truth(da_hidden, token)
        evaluator.update(token, predict_tracks(da_hidden, token), *truth)

    result = evaluator.compute()

    assert result.pooled["hota"] == pytest.approx(1.0)
    assert result.pooled["id_switches"] == 0


def test_an_unknown_task_and_an_impossible_horizon_are_refused(
    da_hidden: DeepAccident, tokens: list[str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    out = tmp_path_factory.mktemp("results") / "out"
    assert_raises(
        (
            lambda: predict_results(da_hidden, "warning", tokens, out),
            ChoiceError,
            (
                "task: expected one of motion, accident, detection, tracking, planning, "
                "forecasting, found 'warning'"
            ),
        ),
        (
            lambda: predict_results(da_hidden, "motion", tokens, out, Baseline(horizon=0.7)),
            ConfigError,
            r"horizon: 0.7 s is not a multiple of 0.5 s; choose 0.5, 1, 1.5, …",
        ),
    )
    assert not out.exists()


CAR_SIZE = (4.0, 2.0, 1.5)
Actor = tuple[int, float, float, float, float, float]
"""Actor id, x, y, yaw, velocity along x, velocity along y; in metres, radians and seconds."""


def make_outlook(
    *actors: Actor, ego_id: int | None = 50, pedestrian_ids: Sequence[int] = ()
) -> Outlook:
    """Make the outlook of cars; the given ids belong to pedestrians instead."""
    table = np.array(actors, dtype=np.float64).reshape(-1, 6)
    ids = table[:, 0].astype(np.int64)
    zeros = np.zeros(len(table))
    boxes = Boxes.from_arrays(
        np.column_stack([table[:, 1:3], zeros]),
        np.tile(CAR_SIZE, (len(table), 1)),
        table[:, 3],
        frame="ego",
        actor_id=ids,
        velocity=np.column_stack([table[:, 4:6], zeros]),
        category=np.where(np.isin(ids, pedestrian_ids), CATEGORIES.index("pedestrian"), 0),
    )
    seen = SeenActors(boxes=boxes, seen_by=np.zeros(len(table), np.uint8), own_actor_id=ego_id)
    return Outlook(seen=seen, turn_rate=zeros)


EGO = (OWN_ACTOR_ID, 0, 0, 0, 10, 0)
CROSSING = (7, 15, -15, np.pi / 2, 0, 10)


def test_crossing_paths_collide_where_the_boxes_first_come_near() -> None:
    (alarm,) = accidents_ahead(make_outlook(EGO, CROSSING), 2.0)
    # at t the centres are (10 t, 0) and (15, −15 + 10 t): the boxes touch once 15 − 10 t ≤ 3
    np.testing.assert_allclose(alarm.positions, [[12, 0], [15, -3]], atol=1e-9)
    assert alarm.time == pytest.approx(1.2)
    assert alarm.ids == (50, 7)
    assert alarm.score == pytest.approx(1 / 2.2)
    # if meta does not say which actor the ego is, the alarm has no ids
    (unknown,) = accidents_ahead(make_outlook(EGO, CROSSING, ego_id=None), 2.0)
    assert unknown.ids is None


PARKED = [(1, 0, 20, 0, 0, 0), (2, 4.1, 20, 0, 0, 0)]
SIDE_BY_SIDE = [(3, 0, 40, 0, 5, 0), (4, 0, 42.1, 0, 5, 0)]


@pytest.mark.parametrize(
    ("actors", "horizon"),
    [((EGO, CROSSING), 1.1), ((*PARKED, *SIDE_BY_SIDE), 2.0), ((), 2.0), ((EGO,), 2.0)],
)
def test_actors_that_do_not_meet_within_the_horizon_raise_no_alarm(
    actors: tuple[Actor, ...], horizon: float
) -> None:
    assert accidents_ahead(make_outlook(*actors), horizon) == []


def test_a_pass_within_the_danger_distance_is_an_alarm_of_less_weight() -> None:
    passing = (7, 20, 2.2, np.pi, -10, 0)  # on the next lane: 0.2 m between the sides
    (alarm,) = accidents_ahead(make_outlook(EGO, passing), 2.0)
    assert alarm.score == pytest.approx((1 - 0.2 / 0.25) / (1 + alarm.time))
    assert accidents_ahead(make_outlook(EGO, passing), 2.0, danger_distance=0.1) == []


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_a_car_that_drives_up_to_a_queue_brakes(yaw: float) -> None:
    """At constant velocity the follower would drive through the standing car within 2 s."""
    forward = np.array([np.cos(yaw), np.sin(yaw)])
    left = np.array([-forward[1], forward[0]])

    def follower(offset: float, turn: float = 0.0) -> Actor:
        position = -12 * forward + offset * left
        return 2, *position, yaw + turn, *(8 * forward)

    standing = (1, 0, 0, yaw, 0, 0)
    assert accidents_ahead(make_outlook(standing, follower(0.5)), 2.0) == []
    assert accidents_ahead(make_outlook(follower(0.5), standing), 2.0) == []
    from_next_lane = make_outlook(standing, follower(1.5))
    sliding = make_outlook(standing, follower(0.5, turn=0.6))
    assert len(accidents_ahead(from_next_lane, 2.0)) == 1
    assert len(accidents_ahead(sliding, 2.0)) == 1


@pytest.mark.parametrize(("pedestrian_ids", "count"), [([], 1), ([2], 1), ([1, 2], 0)])
def test_two_pedestrians_are_in_no_danger_of_each_other(
    pedestrian_ids: list[int], count: int
) -> None:
    meeting = [(1, 0, 0, 0, 1.5, 0), (2, 6, 0.5, np.pi, -1.5, 0)]
    alarms = accidents_ahead(make_outlook(*meeting, pedestrian_ids=pedestrian_ids), 3.0)
    assert len(alarms) == count


def test_two_actors_that_overlap_now_are_the_surest_alarm() -> None:
    overlapping = [(1, 0, 0, 0, 5, 0), (2, 1, 0, 0, 5, 0)]
    (alarm,) = accidents_ahead(make_outlook(*overlapping), 2.0)
    assert (alarm.time, alarm.score) == (0, 1)


def test_only_the_surest_alarm_at_one_place_is_kept() -> None:
    followers = [
        (8, -8, 0, 0, 10, 0),
        (9, 15, -23, np.pi / 2, 0, 10),
    ]
    far_away = [
        (10, 0, 100, 0, 10, 0),
        (11, 17, 85, np.pi / 2, 0, 10),
    ]
    alarms = accidents_ahead(make_outlook(EGO, CROSSING, *followers, *far_away), 3.0)
    assert [alarm.ids for alarm in alarms] == [(50, 7), (10, 11)]
    assert alarms[0].score > alarms[1].score
