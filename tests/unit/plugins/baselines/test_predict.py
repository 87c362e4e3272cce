"""The baselines: motion that is drawn, detections, and accidents that lie ahead."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, DeepAccidentError, NotAvailableError
from deepaccident_devkit.evaluation import (
    AccidentEvaluator,
    DetectedBoxes,
    DetectionEvaluator,
    MotionEvaluator,
    detection_truth,
)
from deepaccident_devkit.evaluation.accident import accident_context
from deepaccident_devkit.evaluation.motion import MOTION_PROTOCOLS
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.geometry import BevGrid, Boxes
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabelConfig, MotionLabels
from deepaccident_devkit.plugins.baselines import (
    MOTION_MODELS,
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
from deepaccident_devkit.plugins.baselines.predict import accidents_ahead, label_times, motion_prediction
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.taxonomy import CATEGORIES, LIDAR, OWN_ACTOR_ID, UNTRACKED_ID
from deepaccident_devkit.v2x import Link


@pytest.fixture(scope="session")
def tokens(da_hidden: DeepAccident) -> list[str]:
    """The ego vehicle's samples 2, 1.5, 1 and 0.5 s before the impact."""
    return [token for token in da_hidden.samples("train", "evaluate") if "/ego_vehicle/" in token]


def test_motion_lies_as_the_labels_that_it_foretells(da_hidden: DeepAccident, tokens: list[str]) -> None:
    config = MotionLabelConfig(grid=BevGrid((-30, 30, 0.5), (-20, 20, 0.5), "fiery"), future_frames=6)
    output = predict_motion(da_hidden, tokens[0], agents="all", config=config)
    assert output.grid == config.grid
    assert output.instances is not None
    assert output.instances.shape == (1, 7, 120, 80)


def test_five_agents_know_the_whole_present(da_hidden: DeepAccident, tokens: list[str]) -> None:
    """All that the label shows, cell by cell; at the rim, who is beyond the ego's own label is in theirs."""
    known = []
    for token in tokens:
        label = da_hidden.motion_labels(token).instance[0, 8:-8, 8:-8] > 0
        maps = [predict_motion(da_hidden, token, agents=agents).instances for agents in ("single", "all")]
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
            together.update(token, predict_motion(da_hidden, token, agents="all", config=config), label)
        score = together.compute().ranges["100x100"].pq
        assert score > least
        assert score > alone.compute().ranges["100x100"].pq + 10


@pytest.mark.parametrize("frame", ["world", "ego", "lidar"])
def test_boxes_of_a_detector_mean_the_accidents_of_those_actors(
    da_hidden: DeepAccident, tokens: list[str], frame: str
) -> None:
    """Nobody is named; unsure boxes do not count, nor those on the ego."""
    for token in tokens:
        boxes = seen_actors(da_hidden, token, agents="all", frame=frame).boxes  # the first one is the ego
        unnamed = replace(boxes, actor_id=np.full(len(boxes), UNTRACKED_ID))
        found, unsure = (
            detected_accidents(da_hidden, token, DetectedBoxes(boxes=unnamed, scores=np.full(len(boxes), score)))
            for score in (0.5, 0.49)
        )
        named = predict_accidents(da_hidden, token, agents="all")
        assert [each.ids for each in found] == [None] * len(named)
        assert [(each.time, each.score) for each in found] == [(each.time, each.score) for each in named]
        for each, other in zip(found, named, strict=True):
            np.testing.assert_allclose(each.positions, other.positions, atol=1e-9)
        assert unsure == []
    assert named


def test_the_hidden_accident_is_foreseen_by_the_pole_and_named(da_hidden: DeepAccident, tokens: list[str]) -> None:
    collision = da_hidden.scenario[0]["collision"]
    assert collision is not None
    token = tokens[1]
    assert predict_accidents(da_hidden, token) == []
    (alarm,) = predict_accidents(da_hidden, token, agents="+infrastructure")
    assert (set(alarm.ids or ()), alarm.time) == (set(collision["ids"]), pytest.approx(1.5, abs=0.11))
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
    order = np.argsort(found.scores[~own])
    assert (np.diff(watchers[~own][order]) >= 0).all()  # who is seen by more is surer


def test_detections_of_all_agents_find_more(da_hidden: DeepAccident, tokens: list[str]) -> None:
    scores = {}
    for agents in ("single", "all"):
        evaluator = DetectionEvaluator("paper")
        for token in tokens:
            found = predict_detections(da_hidden, token, agents=agents)
            lidar = found.boxes.transform(da_hidden.world_from(token, "lidar").inverse(), "lidar")
            evaluator.update(
                token,
                type(found)(boxes=lidar, scores=found.scores),
                detection_truth(da_hidden, token, "paper"),
            )
        scores[agents] = evaluator.compute().mean_average_precision
    assert scores["all"] > scores["single"] + 5


def test_a_link_of_its_own_seed_gives_other_boxes(da_hidden: DeepAccident, tokens: list[str]) -> None:
    one, same, other = (
        predict_motion(da_hidden, tokens[0], agents="all", link=Link(pose_noise=0.5, seed=seed)).instances
        for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)


@pytest.mark.parametrize(
    ("options", "error", "sentence"),
    [
        ({"model": "constant"}, ChoiceError, r"model: expected one of constant_velocity, .*, found 'constant'"),
        ({"horizon": 0.0}, ConfigError, "horizon: expected a number above 0, found 0.0"),
        ({"danger_distance": float("nan")}, ConfigError, "danger_distance: expected a number above 0, found nan"),
        ({"link": 0.3}, ConfigError, "link: expected a Link"),
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
    content = [{path.name: path.read_bytes() for path in root.rglob("*") if path.is_file()} for root in (one, two)]
    assert content[0] == content[1]
    results = read_results(one)
    results.check()
    assert results.tokens == tuple(every)
    assert results.form is not None
    assert (results.form.frames, results.form.labels) == (7, "released")
    assert (results.meta["agents"], results.meta["link"]["latency"]) == ("+infrastructure", 0.1)
    stored = results.prediction(tokens[0])
    expected = chosen.predict(da_hidden, "motion", tokens[0])
    np.testing.assert_array_equal(stored.instances, expected.instances)  # type: ignore[union-attr]


def test_results_of_the_other_tasks(
    da_hidden: DeepAccident, tokens: list[str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("results")
    chosen = Baseline(agents="all", model="constant_turn_rate")
    accident = read_results(predict_results(da_hidden, "accident", tokens, folder / "a.json", chosen, workers=1))
    assert [len(accident.prediction(token)) for token in tokens] == [  # type: ignore[arg-type]
        len(predict_accidents(da_hidden, token, agents="all", model="constant_turn_rate")) for token in tokens
    ]
    assert accident.meta["model"] == "constant_turn_rate"
    detection = read_results(predict_results(da_hidden, "detection", tokens, folder / "d.json", chosen, workers=1))
    assert detection.task == "detection"
    assert len(detection.prediction(tokens[0])) == len(predict_detections(da_hidden, tokens[0], agents="all"))  # type: ignore[arg-type]


@pytest.mark.parametrize("model", ["constant_velocity", "constant_turn_rate", "standing"])
def test_forecasts_are_where_seen_actors_go(da_hidden: DeepAccident, tokens: list[str], model: MotionModel) -> None:
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


def test_of_the_models_standing_moves_nobody(da_hidden: DeepAccident, tokens: list[str]) -> None:
    moved = {}
    for model in MOTION_MODELS:
        ahead = outlook(da_hidden, tokens[0], agents="all", model=model)
        moved[model] = np.linalg.norm(np.ptp(ahead.poses(np.array([0.0, 2.0]))[..., :2], axis=0), axis=-1).max()
    assert moved["standing"] == 0 < min(moved["constant_velocity"], moved["constant_turn_rate"])


def test_a_plan_is_the_egos_own_path(da_hidden: DeepAccident, tokens: list[str]) -> None:
    """In straight and even driving it is the recorded one; the ego frame moves, not the box."""
    token = tokens[0]
    plan = predict_plan(da_hidden, token)
    scenario, agent, number = token.rsplit("/", 2)
    assert (plan.times.tolist(), plan.score) == ([0.5, 1.0, 1.5, 2.0, 2.5, 3.0], 1.0)
    ego_from_world = da_hidden.world_from(token, "ego").inverse()
    recorded = [
        ego_from_world @ da_hidden.world_from(f"{scenario}/{agent}/{int(number) + frames:03d}", "ego")
        for frames in (5, 10)
    ]
    np.testing.assert_allclose(plan.path[:2], [pose.translation[:2] for pose in recorded], atol=1.0)
    assert np.linalg.norm(plan.path[-1]) > 10
    assert plan.yaw is not None
    np.testing.assert_allclose(plan.yaw, 0, atol=1e-9)
    assert not predict_plan(da_hidden, token, model="standing").path.any()
    turning = predict_plan(da_hidden, token, model="constant_turn_rate", horizon=5.0)
    assert (len(turning.times), turning.path[0] == pytest.approx(plan.path[0], abs=0.2)) == (10, True)


def test_the_infrastructure_has_no_plan(da_hidden: DeepAccident, tokens: list[str]) -> None:
    pole = tokens[0].replace("ego_vehicle", "infrastructure")
    assert_refused(
        (lambda: predict_plan(da_hidden, pole), NotAvailableError, (pole, "no own vehicle")),
        (lambda: predict_plan(da_hidden, tokens[0], horizon=0.3), ConfigError, "no number of steps of 0.5 s"),
        (lambda: predict_forecasts(da_hidden, tokens[0], horizon=np.inf), ConfigError, "no number of steps of 0.5 s"),
    )


@pytest.mark.parametrize(("horizon", "steps"), [(2.0, 6), (4.0, 8)])
def test_paths_in_files_look_three_seconds_ahead_at_least(
    da_hidden: DeepAccident, tokens: list[str], tmp_path: Path, horizon: float, steps: int
) -> None:
    baseline = Baseline(model="standing", horizon=horizon)
    for task in ("planning", "forecasting"):
        results = read_results(predict_results(da_hidden, task, tokens, tmp_path / task, baseline, workers=1))
        assert (results.task, results.meta["model"], results.meta["horizon"]) == (task, "standing", steps / 2)
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
            "task: expected one of motion, accident, detection, planning, forecasting, found 'warning'",
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
    *actors: tuple[int, float, float, float, float, float], own: int | None = 50, on_foot: Sequence[int] = ()
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
    assert (alarm.time, alarm.ids, alarm.score) == (pytest.approx(1.2), (50, 7), pytest.approx(1 / 2.2))
    (unknown,) = accidents_ahead(ahead(EGO, CROSSING, own=None), 2.0)  # meta does not say who the ego is
    assert unknown.ids is None


PARKED = [(1, 0, 20, 0, 0, 0), (2, 4.1, 20, 0, 0, 0)]
SIDE_BY_SIDE = [(3, 0, 40, 0, 5, 0), (4, 0, 42.1, 0, 5, 0)]


@pytest.mark.parametrize(
    ("actors", "horizon"), [((EGO, CROSSING), 1.1), ((*PARKED, *SIDE_BY_SIDE), 2.0), ((), 2.0), ((EGO,), 2.0)]
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
    assert len(accidents_ahead(ahead(stands, follower(1.5, 0.0)), 2.0)) == 1  # it comes from the next lane
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


CLEAN = MOTION_PROTOCOLS["released"].__class__(labels="clean")


def what_comes(da: DeepAccident, token: str, config: MotionLabelConfig) -> tuple[SeenActors, FloatArray]:
    """Whom the labels show at the present and all the time, and where they will be: (T, N, 3) in its ego frame."""
    seen = seen_actors(da, token, agents="all")
    scenario, agent, number = token.rsplit("/", 2)
    annotated = set(da.boxes(token, "ego").actor_id.tolist())
    poses = []
    for frame in range(config.label_frames):
        boxes = da.boxes(f"{scenario}/{agent}/{int(number) + frame * config.step:03d}", "world")
        boxes = boxes.transform(da.world_from(token, "ego").inverse(), "ego")
        annotated &= set(boxes.actor_id.tolist())
        poses.append(boxes)
    rows = np.flatnonzero(np.isin(seen.boxes.actor_id, list(annotated)))
    seen = SeenActors(boxes=seen.boxes.select(rows), seen_by=seen.seen_by[rows], own_actor_id=seen.own_actor_id)
    result = []
    for boxes in poses:
        place = [int(np.flatnonzero(boxes.actor_id == actor)[0]) for actor in seen.boxes.actor_id]
        result.append(np.column_stack([boxes.center[place, :2], boxes.yaw[place]]))
    return seen, np.stack(result)


def without_others(label: MotionLabels, known: set[int]) -> MotionLabels:
    """The label without those whose whole future the labels do not tell: they leave the range, or come into sight."""
    others = [number for actor, number in label.id_map.items() if actor not in {*known, OWN_BOX_ID}]
    gone = np.isin(label.instance, others)
    instance, segmentation = (np.where(gone, 0, each) for each in (label.instance, label.segmentation))
    return replace(label, instance=instance, segmentation=segmentation)


@pytest.mark.parametrize("agent", ["ego_vehicle", "other_vehicle_behind", "infrastructure"])
@pytest.mark.parametrize("protocol", ["released", "clean"])
def test_who_foresees_everything_scores_a_hundred(da_motion: DeepAccident, agent: str, protocol: str) -> None:
    """Cell by cell."""
    config = MotionLabelConfig(protocol=protocol)
    token = f"{da_motion.scenario[0]['token']}/{agent}/012"
    seen, poses = what_comes(da_motion, token, config)
    output = motion_prediction(seen, poses, da_motion.ego_from(token, LIDAR), config)
    evaluator = MotionEvaluator("released" if protocol == "released" else CLEAN)
    label = da_motion.motion_labels(token, config)
    evaluator.update(token, output, without_others(label, set(seen.boxes.actor_id.tolist())))
    result = evaluator.compute()
    assert len(seen.boxes) > 5
    for each in result.ranges.values():
        assert each.sq > 99.9
        assert (each.false_positive, each.false_negative) == (0, 0)
    assert result.ranges["100x100"].true_positive > 40


def test_the_present_is_drawn_exactly_as_labels_are(da_motion: DeepAccident) -> None:
    config = MotionLabelConfig()
    token = f"{da_motion.scenario[0]['token']}/ego_vehicle/012"
    label = da_motion.motion_labels(token)
    seen = seen_actors(da_motion, token, agents="all")
    rows = np.flatnonzero(np.isin(seen.boxes.actor_id, da_motion.boxes(token, "ego").actor_id))
    boxes = seen.boxes.select(rows)
    seen = SeenActors(boxes=boxes, seen_by=seen.seen_by[rows], own_actor_id=seen.own_actor_id)
    standing = np.repeat(np.column_stack([boxes.center[:, :2], boxes.yaw])[None], config.label_frames, axis=0)
    output = motion_prediction(seen, standing, da_motion.ego_from(token, LIDAR), config)
    assert output.instances is not None
    assert output.instances.shape == (1, 5, 200, 200)
    np.testing.assert_array_equal(output.instances[0, 0] > 0, label.instance[0] > 0)
    assert (output.instances[0] > 0).any(axis=(1, 2)).all()


def test_ids_stay_the_same_over_the_frames(da_motion: DeepAccident) -> None:
    config = MotionLabelConfig()
    token = f"{da_motion.scenario[0]['token']}/ego_vehicle/012"
    seen, poses = what_comes(da_motion, token, config)
    only = np.flatnonzero(seen.boxes.actor_id == OWN_ACTOR_ID)
    alone = SeenActors(boxes=seen.boxes.select(only), seen_by=seen.seen_by[only], own_actor_id=seen.own_actor_id)
    output = motion_prediction(alone, poses[:, only], da_motion.ego_from(token, LIDAR), config)
    assert output.instances is not None
    assert [np.unique(frame).tolist() for frame in output.instances[0]] == [[0, 1]] * 5


@pytest.mark.parametrize(
    ("config", "times"),
    [(MotionLabelConfig(), [0, 0.5, 1, 1.5, 2]), (MotionLabelConfig(step=1, future_frames=3), [0, 0.1, 0.2, 0.3])],
)
def test_label_times_are_the_label_frames(config: MotionLabelConfig, times: list[float]) -> None:
    np.testing.assert_allclose(label_times(config), times)
