import csv
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.baselines import (
    METRICS,
    StudyConfig,
    StudyRow,
    StudyTable,
    V2XStudy,
    predict_detections,
    v2x_study,
)
from deepaccident_devkit.baselines.conditions import Condition
from deepaccident_devkit.baselines.counting import Counting, Evaluators, counted, drawn
from deepaccident_devkit.baselines.figures import study_panels
from deepaccident_devkit.baselines.study_rows import study_row
from deepaccident_devkit.baselines.study_samples import study_samples
from deepaccident_devkit.errors import ChoiceError, ConfigError, NotAvailableError
from deepaccident_devkit.evaluation import DetectedBoxes, DetectionEvaluator, Resampling, detection_truth
from deepaccident_devkit.evaluation.metrics.intervals import intervals_of
from deepaccident_devkit.v2x import AGENT_CONFIGS

pytestmark = pytest.mark.slow

QUICK = StudyConfig(quick=True, seeds=[0, 1])
TABLES = ["configurations", "visibility", "horizons", "pose_noise", "latency"]


@pytest.fixture(scope="module")
def study(da_hidden: DeepAccident) -> V2XStudy:
    return v2x_study(da_hidden, "train", QUICK, workers=1)


def rows(study: V2XStudy, table: str, **wanted: object) -> list[StudyRow]:
    return [
        row for row in study.tables[table].rows if all(getattr(row, name) == value for name, value in wanted.items())
    ]


def test_it_has_the_papers_tables_and_configurations(study: V2XStudy) -> None:
    assert list(study.tables) == TABLES
    assert [row.agents for row in study.tables["configurations"].rows] == list(AGENT_CONFIGS)
    assert {row.group for row in study.tables["visibility"].rows} == {"visible", "invisible"}
    assert {(row.horizon, row.group) for row in study.tables["horizons"].rows} >= {(2.0, "2 s"), (4.0, "3 s")}
    assert {row.pose_noise for row in study.tables["pose_noise"].rows} == {0.0, 0.2, 0.5}
    assert {row.agents for row in study.tables["latency"].rows} == {"+infrastructure", "all"}
    assert all(row.metrics.keys() == METRICS.keys() for table in study.tables.values() for row in table.rows)


def test_whoever_sees_more_foresees_more(study: V2XStudy) -> None:
    single, everybody = (rows(study, "configurations", agents=name)[0].metrics for name in ("single", "all"))
    for name in ("iou_100", "vpq_100", "apa", "boxes_apa", "boxes_recall", "mAP"):
        assert (everybody[name] or 0) > (single[name] or 0), name
    unseen, together = (
        rows(study, "visibility", agents=name, group="invisible")[0].metrics for name in ("single", "all")
    )
    assert unseen["apa"] == unseen["boxes_recall"] == 0
    assert together["apa"] == 1


def test_noise_and_delay_make_it_worse(study: V2XStudy) -> None:
    for table, field in (("pose_noise", "pose_noise"), ("latency", "latency")):
        values = [row.metrics["iou_100"] for row in rows(study, table, agents="all")]
        assert values == sorted(values, reverse=True), field
        assert values[0] > values[-1] + 3  # type: ignore[operator]


def test_the_same_samples_stand_in_all_rows(study: V2XStudy) -> None:
    perfect = rows(study, "configurations", agents="all")[0]
    assert {row.samples for name in ("configurations", "pose_noise", "latency") for row in study.tables[name].rows} == {
        4
    }
    for table in ("pose_noise", "latency"):
        assert rows(study, table, agents="all")[0].metrics == perfect.metrics
    parts = rows(study, "visibility", agents="single")
    assert sum(part.samples for part in parts) == perfect.samples


def test_samples_without_a_past_for_the_delay_are_left_out_everywhere(study: V2XStudy) -> None:
    assert study.notes == (
        "4 s ahead: 1 of 7 samples are left out, since their scenario lacks an agent or has no past of 0.5 s",
    )
    assert {row.samples for row in rows(study, "horizons", horizon=4.0, group="all")} == {6}


def test_two_workers_give_the_same_bits(da_hidden: DeepAccident) -> None:
    counting = Counting(dataset=da_hidden, model="constant_velocity", protocol="paper", seeds=(0, 1))
    conditions = [Condition(agents="all", pose_noise=0.3), Condition(agents="single")]
    samples = dict.fromkeys(da_hidden.samples("train", "evaluate")[:6], conditions)
    one, two = (counted(counting, samples, workers=workers) for workers in (1, 2))
    for condition in conditions:
        for name in ("motion", "maps", "boxes", "detection"):
            first, second = (getattr(each[condition], name) for each in (one, two))
            assert first.compute().as_dict() == second.compute().as_dict()
            assert len(second) == 6 * len(condition.seeds(counting.seeds))


def test_its_forms_say_the_same(study: V2XStudy, tmp_path: Path) -> None:
    text = study.to_text()
    assert "accidents in maps by the protocol 'paper'" in text
    assert "fewer than 6 clusters" in text
    assert all(table.title in text for table in study.tables.values())
    assert [path.name for path in study.to_csv(tmp_path)] == [f"{name}.csv" for name in TABLES]
    with (tmp_path / "visibility.csv").open(encoding="utf-8") as file:
        first = next(csv.DictReader(file))
    assert (first["agents"], first["group"], first["position_error"]) == ("single", "invisible", "")
    assert float(first["iou_100"]) == study.tables["visibility"].rows[0].metrics["iou_100"]
    described = study.as_dict()
    assert described["config"]["egos"] == ["ego_vehicle"]
    assert described["tables"]["latency"]["rows"][0]["metrics"]["apa"] == 1
    with pytest.raises(TypeError, match="cannot be changed"):
        study.tables["latency"] = study.tables["horizons"]  # type: ignore[index]


def test_a_table_is_drawn_by_horizon_and_metric(study: V2XStudy) -> None:
    assert [len(row) for row in study_panels(study.tables["horizons"])] == [5, 5]
    (panels,) = study_panels(study.tables["latency"])
    assert panels[0].xlabel == "latency (s)"
    assert list(panels[0].values["all"]) == [0.0, 0.2, 0.5]
    (bars,) = study_panels(study.tables["visibility"])
    assert bars[2].values["single"] == {"invisible": 0.0, "visible": 1.0}
    assert [panel.top for panel in bars] == [100, 100, 1, 1, 100]


def test_map_is_of_the_detections_that_are_predicted(da_hidden: DeepAccident, study: V2XStudy) -> None:
    evaluator = DetectionEvaluator("paper")
    for token in study_samples(da_hidden, "train", [2.0], egos=["ego_vehicle"]).tokens[2.0]:
        given, world = predict_detections(da_hidden, token, agents="+other"), da_hidden.world_from(token, "lidar")
        boxes = DetectedBoxes(boxes=given.boxes.transform(world.inverse(), "lidar"), scores=given.scores)
        evaluator.update(token, boxes, detection_truth(da_hidden, token, "paper"))
    (row,) = rows(study, "configurations", agents="+other")
    assert row.metrics["mAP"] == pytest.approx(evaluator.compute().mean_average_precision)


def test_noise_is_drawn_with_each_seed(da_hidden: DeepAccident, study: V2XStudy) -> None:
    tokens = study_samples(da_hidden, "train", [2.0], egos=["ego_vehicle"], latest=0.5).tokens[2.0]
    noisy = Condition(agents="all", pose_noise=0.5)
    alone = []
    for seed in (0, 1):
        counting = Counting(dataset=da_hidden, model="constant_velocity", protocol="paper", seeds=[seed])
        evaluators = counted(counting, {token: [noisy] for token in tokens}, workers=1)[noisy]
        alone.append(evaluators.motion.compute().ranges["100x100"].iou)
    (row,) = rows(study, "pose_noise", agents="all", pose_noise=0.5)
    least, most = row.spread["iou_100"]
    assert [least, most] == sorted(alone)
    assert least < row.metrics["iou_100"] < most  # type: ignore[operator]
    assert (row.samples, row.positives, row.scenarios) == (4, 4, 1)
    assert "least and most of single seeds" in study.tables["pose_noise"].to_text()
    for name in ("configurations", "latency"):
        assert not any(row.spread for row in study.tables[name].rows)
        assert "single seeds" not in study.tables[name].to_text()


def copied(evaluators: Evaluators, tokens: list[str], scenarios: list[str], seeds: list[int]) -> list[str]:
    """Each scenario gets the counts of one more sample than the one before, over and over; returns their tokens."""
    made = []
    for place, scenario in enumerate(scenarios):
        for token in tokens[: 1 + place % len(tokens)]:
            made.append(f"{scenario}/{token.split('/', 2)[2]}")
            for evaluator in (evaluators.motion, evaluators.maps, evaluators.boxes, evaluators.detection):
                for seed in seeds:
                    counts = dict(evaluator.counts[drawn(token, seed)])
                    if "token" in counts:
                        counts["token"] = drawn(made[-1], seed)
                    evaluator.add(drawn(made[-1], seed), counts)
    return made


def test_intervals_are_over_clusters_with_all_their_seeds(da_hidden: DeepAccident) -> None:
    noisy, seeds = Condition(agents="+infrastructure", pose_noise=0.5), [0, 1]
    perfect = Condition(agents="+infrastructure")
    assert noisy.base == perfect
    assert perfect.base == Condition(agents="single")
    counting = Counting(dataset=da_hidden, model="constant_velocity", protocol="paper", seeds=seeds)
    tokens = study_samples(da_hidden, "train", [2.0], egos=["ego_vehicle"], latest=0.5).tokens[2.0]
    found = counted(counting, {token: [noisy, perfect] for token in tokens}, workers=1)
    evaluators = found[noisy]
    pairs = [f"type1_subtype1_{kind}/Town0{place}" for place in range(6) for kind in ("accident", "normal")]
    made = copied(evaluators, list(tokens), pairs, seeds)
    copied(found[perfect], list(tokens), pairs, [0])
    config = StudyConfig(seeds=seeds)
    row = study_row(noisy, "all", made, found, config)
    assert (row.samples, row.scenarios, row.clusters, row.positives) == (len(made), 12, 6, len(made))
    counts = evaluators.motion.counts
    clusters = [
        [counts[drawn(token, seed)] for token in made if f"/Town0{place}/" in token for seed in seeds]
        for place in range(6)
    ]
    result = evaluators.motion.result_of([each for cluster in clusters for each in cluster])
    wanted = intervals_of(evaluators.motion, clusters, result).ends["ranges/100x100/iou"]
    assert row.intervals["iou_100"] == pytest.approx(wanted)
    assert {"apa", "boxes_recall", "mAP"} <= row.intervals.keys()
    for name, (low, high) in row.intervals.items():
        assert low <= row.metrics[name] <= high, name  # type: ignore[operator]
    five = study_row(noisy, "all", [token for token in made if "/Town05/" not in token], found, config)
    assert (five.scenarios, five.clusters, dict(five.intervals), dict(five.gains)) == (10, 5, {}, {})
    off = StudyConfig(seeds=seeds, resampling=Resampling(resamples=0))
    assert not study_row(noisy, "all", made, found, off).intervals
    difference = (
        row.metrics["iou_100"]
        - found[perfect]
        .motion.compute(  # type: ignore[operator]
            drawn(token, 0) for token in made
        )
        .ranges["100x100"]
        .iou
    )
    least, most = row.gains["iou_100"]
    assert least < difference < most < 0
    assert (least + most) / 2 == pytest.approx(difference)

    table = StudyTable(name="pose_noise", title="Noise", by=("agents", "pose_noise"), rows=(row,))
    low, high = row.intervals["iou_100"]
    assert f"{row.metrics['iou_100']:.1f} [{low:.1f}, {high:.1f}]" in table.to_text()
    assert max(map(len, replace(table, by=("agents", "horizon", "group")).to_text().splitlines())) <= 160
    (read,) = csv.DictReader(table.to_csv().splitlines())
    assert [float(read[f"iou_100_{end}"]) for end in ("low", "high")] == [low, high]
    assert [float(read[f"mAP_{end}"]) for end in ("least", "most")] == list(row.spread["mAP"])
    assert [float(read[f"iou_100_gain_{end}"]) for end in ("low", "high")] == [least, most]
    assert (read["scenarios"], read["clusters"]) == ("12", "6")
    ((panel, *_),) = study_panels(table)
    assert panel.intervals == {"+infrastructure": {0.5: (low, high)}}


def test_configurations_whose_agents_are_nowhere_are_left_out(da_hidden: DeepAccident, tmp_path: Path) -> None:
    root = tmp_path / "partial"
    shutil.copytree(da_hidden.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident", "other_vehicle_behind"))
    partial = DeepAccident("v1", root, verbose=False)
    found = study_samples(partial, "train", [2.0], egos=["ego_vehicle"])
    assert found.agents == ("single", "+behind", "+other", "+infrastructure", "+behind+other")
    assert found.notes == ("left out, since an agent is not in this release: vehicles, all",)
    assert len(found.tokens[2.0]) == 4
    with pytest.raises(NotAvailableError, match="train: no sample here of other_vehicle_behind can be compared"):
        study_samples(partial, "train", [2.0], egos=["other_vehicle_behind"])


@pytest.mark.parametrize("protocol", ["released", "boxes"])
def test_other_protocols_and_egos(da_hidden: DeepAccident, monkeypatch: pytest.MonkeyPatch, protocol: str) -> None:
    monkeypatch.setattr("deepaccident_devkit.baselines.conditions._QUICK_HORIZONS", (2.0,))
    monkeypatch.setattr("deepaccident_devkit.baselines.conditions._QUICK_STEPS", (0.0,))
    off = Resampling(resamples=0)
    config = StudyConfig(quick=True, protocol=protocol, egos=["other_vehicle"], resampling=off)
    study = v2x_study(da_hidden, "train", config, workers=1)
    assert rows(study, "configurations", agents="all")[0].metrics["apa"] is not None
    assert "ego: other_vehicle;" in study.to_text()
    assert "[low, high]" not in study.to_text()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"egos": "ego_vehicle"}, r"egos: expected several agents, found 'ego_vehicle'; give \['ego_vehicle'\]"),
        ({"egos": ["ego"]}, "egos: expected one of ego_vehicle, .*, found 'ego'"),
        ({"egos": []}, "egos: expected at least one agent, found none"),
        ({"model": "still"}, "model: expected one of constant_velocity, constant_turn_rate, found 'still'"),
        ({"protocol": "mine"}, "protocol: expected one of released, paper, boxes, found 'mine'"),
        ({"scope": "some"}, "scope: expected one of accident, all, found 'some'"),
    ],
)
def test_configurations_that_cannot_be_are_refused(options: dict[str, object], sentence: str) -> None:
    with pytest.raises(ChoiceError, match=sentence):
        StudyConfig(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize("seeds", [(), (0, 0), (0.5,)])
def test_seeds_that_cannot_be_are_refused(seeds: tuple[int, ...]) -> None:
    with pytest.raises(ConfigError, match="seeds: expected one or more whole numbers, each once, found"):
        StudyConfig(seeds=seeds)
