import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.baselines import (
    Baseline,
    predict_accidents,
    predict_detections,
    predict_motion,
    predict_results,
    seen_actors,
)
from deepaccident_devkit.errors import ChoiceError, ConfigError, DeepAccidentError
from deepaccident_devkit.evaluation import AccidentEvaluator, DetectionEvaluator, MotionEvaluator, detection_truth
from deepaccident_devkit.evaluation.accident import accident_context
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID
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


def test_the_hidden_accident_is_foreseen_by_the_pole_and_named(da_hidden: DeepAccident, tokens: list[str]) -> None:
    collision = da_hidden.scenario[0]["collision"]
    assert collision is not None
    token = tokens[1]
    assert predict_accidents(da_hidden, token) == []
    (alarm,) = predict_accidents(da_hidden, token, agents="+infrastructure")
    assert set(alarm.ids or ()) == set(collision["ids"])
    assert alarm.time == pytest.approx(1.5, abs=0.11)
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
    with pytest.raises(error, match=sentence):
        predict_accidents(da_hidden, tokens[0], **options)  # type: ignore[arg-type]


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
    assert results.meta["agents"] == "+infrastructure"
    assert results.meta["link"]["latency"] == 0.1
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


def test_a_task_or_horizon_that_is_none_is_refused(
    da_hidden: DeepAccident, tokens: list[str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    out = tmp_path_factory.mktemp("results") / "out"
    assert_refused(
        (
            lambda: predict_results(da_hidden, "warning", tokens, out),
            ChoiceError,
            "task: expected one of motion, accident, detection, found 'warning'",
        ),
        (
            lambda: predict_results(da_hidden, "motion", tokens, out, Baseline(horizon=0.7)),
            ConfigError,
            r"horizon: 0.7 s is no number of steps of 0.5 s; choose 0.5, 1, 1.5, …",
        ),
    )
    assert not out.exists()
