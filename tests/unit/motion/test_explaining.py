"""`MotionLabels.explain`: who painted a cell, from which box, through which warp and quirks, beside a prediction."""

import json
import pickle
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from shapely.geometry import Point, Polygon

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import ConfigError, GeometryError, NotAvailableError
from deepaccident_devkit.evaluation import MotionOutput
from deepaccident_devkit.evaluation.results import ResultsWriter
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS, Orientation
from deepaccident_devkit.motion import (
    LABEL_PROTOCOLS,
    OWN_BOX_ID,
    Augmentation,
    CellBox,
    CellExplanation,
    FrameBoxes,
    LabelFiles,
    MotionHeads,
    MotionLabelConfig,
    MotionLabels,
    explain_cell,
    explain_cell_from_boxes,
    motion_labels_from_boxes,
    predict_instances,
    write_label_files,
)
from deepaccident_devkit.motion.drawing import from_boxes, polygon_fill
from deepaccident_devkit.motion.explaining.boxes import FrameCandidates
from deepaccident_devkit.motion.explaining.quirks import WORDS, Remaker
from deepaccident_devkit.motion.explaining.sources import place_in
from deepaccident_devkit.motion.protocols import slip_names

EGO, POLE = f"{tiny.TOKEN}/ego_vehicle", f"{tiny.TOKEN}/infrastructure"
VAN, LATER, WALKER, TRUCK, UNDER = 1300, 1301, 1302, 1303, 1304
TURNED = MotionLabelConfig(augmentation=Augmentation(rotation=0.3, scale=1.1, flip=True))
CONFIGS = [
    *(
        MotionLabelConfig(protocol=protocol, orientation=orientation)
        for protocol in ("released", "clean")
        for orientation in ORIENTATIONS
    ),
    MotionLabelConfig.preset("fiery"),
    MotionLabelConfig.preset("beverse"),
    MotionLabelConfig(filter_invisible=False, protocol="clean", future_frames=2, step=3),
    replace(TURNED, grid=BevGrid(x=(-20, 40, 0.5), y=(-30, 30, 1.0)), receptive_field=1),
]


def lines(agent: str, frame: int) -> list[str]:
    """tiny's own row and van; a car that nobody sees before frame 11, two boxes one over the other, and a walker."""
    seen = frame >= 11
    return [
        *tiny.label_lines(agent, frame)[:-1],
        f"car 14.0 7.0 -1.0 4.5 1.9 1.5 0.3 0.0 0.0 {LATER} {9 * seen} {seen}",
        f"car -12.0 8.0 -1.0 4.5 1.9 1.5 0.5 0.0 0.0 {UNDER} 9 True",
        f"truck -12.0 9.0 -1.0 8.5 2.6 3.5 0.0 0.0 0.0 {TRUCK} 9 True",
        f"pedestrian 6.0 -5.0 -0.9 0.6 0.6 1.86 0.0 0.0 0.0 {WALKER} 9 True",
        "car -20.0 -10.0 -1.0 4.5 1.9 1.5 0.0 0.0 0.0 -1 99 True",
    ]


def turning(agent: str, frame: int) -> np.ndarray:
    """The ego drives a left turn: 2 degrees and 0.6 m a frame."""
    return tiny.pose(2.0 * frame, x=0.6 * frame, z=0.5) if agent == "ego_vehicle" else tiny.pose(0, x=-20.0, z=0.5)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DeepAccident]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiny, "ego_to_world", turning)
        root = tiny.write_tiny_release(tmp_path_factory.mktemp("tiny") / "release", frames=31, lines_of=lines)
        yield DeepAccident(dataroot=root, verbose=False, workers=1)


@pytest.fixture
def _no_quirks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where they do not matter: finding them takes most of the time."""
    monkeypatch.setattr(Remaker, "quirks", lambda *_: ())


def painted(labels: MotionLabels, t: int, actor: int) -> list[tuple[int, int]]:
    return [(int(row), int(col)) for row, col in np.argwhere(labels.instance[t] == labels.id_map[actor])]


def actor_at(labels: MotionLabels, t: int, row: int, col: int) -> int | None:
    """Read from the labels alone; −1 is an id that no actor has."""
    if labels.segmentation[t, row, col] != 1:
        return None
    return {value: key for key, value in labels.id_map.items()}.get(int(labels.instance[t, row, col]), -1)


def switches(told: CellExplanation) -> set[str]:
    return {quirk.switch for quirk in told.quirks}


def change(told: CellExplanation, switch: str, what: str) -> tuple[object, object]:
    (quirk,) = (quirk for quirk in told.quirks if quirk.switch == switch)
    (one,) = (each for each in quirk.changes if each.what == what)
    return one.here, one.without


def some_cells(labels: MotionLabels, rng: np.random.Generator) -> list[tuple[int, int, int]]:
    """Of every frame and actor two painted cells, one just beside an actor, and two anywhere."""
    chosen = []
    for t in range(len(labels.instance)):
        shape = labels.instance[t].shape
        for identity in np.unique(labels.instance[t][labels.segmentation[t] == 1]):
            cells = np.argwhere(labels.instance[t] == identity)
            chosen += [(t, *cell) for cell in rng.permutation(cells)[:2].tolist()]
            chosen.append((t, *np.clip(cells[0] - 1, 0, np.array(shape) - 1).tolist()))
        chosen += [(t, *cell) for cell in rng.integers(0, shape, (2, 2)).tolist()]
    return chosen


@pytest.mark.slow
@pytest.mark.usefixtures("_no_quirks")
@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize("place", ["own", "nearest", "bilinear"])
def test_the_painter_is_the_actor_of_the_label(small: DeepAccident, config: MotionLabelConfig, place: str) -> None:
    """Found from boxes alone; and the box is the one that the public calls give."""
    number, covered = 0, 0
    for token in (f"{EGO}/006", f"{POLE}/021"):
        made = small.motion_labels(token, config)
        labels = made if place == "own" else made.to_present(place)
        for t, row, col in some_cells(labels, np.random.default_rng(3)):
            told = labels.explain(t, row, col)
            assert told.disagrees == (), told.text
            assert (None if told.painter is None else told.painter.actor_id) == actor_at(labels, t, row, col)
            assert told.values.instance == labels.instance[t, row, col]
            if told.painter is not None:
                check_box(small, token, told, told.painter, config)
                number += 1
                covered += bool(told.covered)
    assert number > 60
    assert covered > 0


def check_box(
    release: DeepAccident, token: str, told: CellExplanation, box: CellBox, config: MotionLabelConfig
) -> None:
    assert told.frame_sample == f"{token.rsplit('/', 1)[0]}/{int(token[-3:]) + told.t * config.step:03d}"
    assert box.annotation == f"{told.frame_sample}/{box.row}"
    record = release.get("annotation", box.annotation)
    assert record["actor_id"] == (-100 if box.actor_id == OWN_BOX_ID else box.actor_id)
    assert record["instance_token"] == box.instance
    assert record["category"] == box.category
    most = 1.5 if config.rules.half_cell_shift else 1.0  # cells: half by rounding corners, half by the outline
    assert box.distance <= most * np.hypot(config.grid.x[2], config.grid.y[2])
    if config.augmentation is None:
        corners = next(each for each in release.get_boxes(told.frame_sample, "ego") if each.token == box.annotation)
        expected = corners.bottom_corners().T[:, :2]
        assert_same_points(box.corners, expected)
        present = release.transform(token, told.frame_sample) @ np.column_stack([expected, np.zeros(4)])
        assert_same_points(box.corners_at_present, present[:, :2])


def assert_same_points(found: object, expected: np.ndarray) -> None:
    """In any order."""
    one, other = np.asarray(found), np.asarray(expected)
    distances = np.hypot(*(one[:, None] - other).transpose(2, 0, 1))
    assert_allclose(distances.min(axis=1), 0, atol=2e-4)
    assert_allclose(distances.min(axis=0), 0, atol=2e-4)


class TestWarp:
    @pytest.mark.usefixtures("_no_quirks")
    def test_the_source_cell_lies_where_the_motion_says(self, small: DeepAccident) -> None:
        labels = small.motion_labels(f"{EGO}/006", MotionLabelConfig(protocol="clean")).to_present()
        for row, col in painted(labels, 4, VAN)[::5]:
            source = labels.explain(4, row, col).source
            x, y, yaw = source.motion
            turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            there = turn @ source.center + (x, y)
            assert np.hypot(*(there - labels.config.grid.centers()[row, col])) <= 0.3536
            assert yaw == pytest.approx(np.radians(-40), abs=1e-3)  # CARLA's angles are clockwise

    @pytest.mark.usefixtures("_no_quirks")
    @pytest.mark.parametrize("config", [CONFIGS[0], CONFIGS[2], CONFIGS[6], CONFIGS[9]])
    def test_blended_cells_give_the_centerness(self, small: DeepAccident, config: MotionLabelConfig) -> None:
        own = small.motion_labels(f"{EGO}/006", config)
        labels = own.to_present("bilinear")
        for row, col in painted(labels, 3, VAN)[::9]:
            source = labels.explain(3, row, col).source
            assert source.centerness == "bilinear"
            value = sum(weight * own.centerness[(3, 0, *cell)] for cell, weight in source.blended)
            assert value == pytest.approx(labels.centerness[3, 0, row, col], abs=1e-4)
            assert own.instance[3][source.cell] == labels.instance[3, row, col]

    def test_what_comes_from_outside(self, small: DeepAccident) -> None:
        labels = small.motion_labels(f"{EGO}/006").to_present()
        told = labels.explain(4, 199, 0)
        assert (told.source.cell, told.source.center, told.painter, told.nearest) == (None, None, None, None)
        assert change(told, "outside_is_zero", "offset") == ((0, 0), (255, 255))
        assert "comes from outside" in told.text

    def test_vectors_that_do_not_turn(self, small: DeepAccident) -> None:
        labels = small.motion_labels(f"{EGO}/006").to_present()
        row, col = painted(labels, 4, VAN)[0]
        told = labels.explain(4, row, col)
        here, without = change(told, "vectors_not_rotated", "offset")
        assert here == tuple(labels.offset[4, :, row, col])
        assert np.hypot(*np.subtract(here, without)) > 1
        assert "vectors_not_rotated" not in switches(labels.explain(0, *painted(labels, 0, VAN)[0]))

    @given(st.sampled_from(ORIENTATIONS), st.sampled_from(ORIENTATIONS), st.data())
    def test_places_turn_as_rasters_do(self, one: Orientation, other: Orientation, data: st.DataObject) -> None:
        grid = BevGrid(x=(0, 7, 1), y=(0, 4, 1), orientation=one)
        row, col = (data.draw(st.integers(0, count - 1)) for count in grid.shape)
        numbers = np.arange(grid.cells).reshape(grid.shape)
        place = place_in(row, col, grid, one, other)
        assert grid.reorient(numbers, other)[tuple(int(each) for each in place)] == numbers[row, col]


class TestBoxes:
    @pytest.mark.usefixtures("_no_quirks")
    def test_the_last_box_of_several_paints(self, small: DeepAccident) -> None:
        labels = small.motion_labels(f"{EGO}/006")
        both = [labels.explain(0, *cell) for cell in painted(labels, 0, TRUCK)[::3]]
        over = [told for told in both if told.covered]
        assert over
        assert {box.actor_id for told in over for box in told.covered} == {UNDER}
        assert "Under it, overwritten: car 1304" in over[0].text
        assert len(both) > len(over)

    def test_who_is_seen_only_later(self, small: DeepAccident) -> None:
        labels = small.motion_labels(f"{EGO}/006")
        row, col = painted(small.motion_labels(f"{EGO}/006", MotionLabelConfig(protocol="clean")), 1, LATER)[20]
        told = labels.explain(1, row, col)
        (box,) = told.left_out
        assert (told.painter, box.actor_id, box.label_id, box.seen_at) == (None, LATER, None, (1, 2, 3, 4))
        assert "no agent whose sight counts sees it at the present (drawn_when='present')" in box.left_out
        assert change(told, "drawn_when", "actor") == (None, LATER)
        assert "1301 in place of nobody" in told.text

    @pytest.mark.parametrize(
        ("changes", "actor", "why"),
        [
            ({"only_vehicle": True}, WALKER, "only_vehicle leaves out pedestrians"),
            ({"draw_ego": False}, OWN_BOX_ID, "draw_ego is off"),
            ({"filter_invisible": True}, -1, "untracked rows (id −1) count as seen by nobody"),
        ],
    )
    def test_who_is_left_out_by_the_configuration(
        self, small: DeepAccident, changes: dict[str, bool], actor: int, why: str
    ) -> None:
        everybody = small.motion_labels(f"{EGO}/006", MotionLabelConfig(filter_invisible=False))
        cells = painted(everybody, 0, actor)
        labels = small.motion_labels(f"{EGO}/006", MotionLabelConfig(**changes))
        told = labels.explain(0, *cells[len(cells) // 2])
        assert told.painter is None
        assert [box.actor_id for box in told.left_out] == [actor]
        assert why in told.left_out[0].left_out
        assert why in told.text

    def test_an_empty_cell_names_the_nearest_box(self, small: DeepAccident) -> None:
        labels = small.motion_labels(f"{EGO}/006")
        told = labels.explain(0, 100, 100 + 20)
        boxes = [box for box in small.get_boxes(f"{EGO}/006", "ego") if box.actor_id not in (LATER, -1)]
        gaps = {box.actor_id: Polygon(box.bottom_corners().T[:, :2]).distance(Point(told.center)) for box in boxes}
        nearest = min(gaps, key=gaps.__getitem__)
        assert told.nearest is not None
        assert (told.nearest.actor_id, told.painter) == (OWN_BOX_ID if nearest == -100 else nearest, None)
        assert told.nearest.distance == pytest.approx(gaps[nearest], abs=1e-4)

    def test_a_box_stands_in_for_a_missing_own_row(self, tmp_path: Path) -> None:
        release = DeepAccident(
            dataroot=tiny.write_tiny_release(tmp_path, lines_of=lambda *_: ["0.0 0.0"]), verbose=False, workers=1
        )
        labels = release.motion_labels(f"{EGO}/002")
        told = labels.explain(0, 100, 100)
        assert told.painter is not None
        assert (told.painter.row, told.painter.annotation, told.painter.actor_id) == (None, None, OWN_BOX_ID)
        assert change(told, "own_box_default", "actor") == (OWN_BOX_ID, None)
        assert "stands in for the ego's own row" in told.text

    @pytest.mark.usefixtures("_no_quirks")
    def test_the_box_of_a_cell(self, small: DeepAccident) -> None:
        own = small.motion_labels(f"{EGO}/006", MotionLabelConfig(protocol="clean"))
        cells = painted(own, 2, VAN)
        told = own.explain(2, *cells[0])
        assert (told.seconds, told.source.warped, told.frame_sample) == (1.0, False, f"{EGO}/016")
        check_box(small, f"{EGO}/006", told, told.painter, own.config)
        assert told.painter.cells == len(cells)
        assert set(told.painter.raster) <= {*cells}
        ego = own.to_present().explain(0, *painted(own, 0, OWN_BOX_ID)[0])
        assert (ego.painter.row, ego.painter.instance, ego.source.warped) == (
            0,
            f"{tiny.TOKEN}/actor/1223",
            False,
        )

    @pytest.mark.usefixtures("_no_quirks")
    def test_the_centre_of_the_peak(self, small: DeepAccident) -> None:
        labels = small.motion_labels(f"{EGO}/006")
        row, col = painted(labels, 0, TRUCK)[0]
        told = labels.explain(0, row, col)
        down, along = labels.offset[0, :, row, col].tolist()
        assert (told.peak.actor_id, told.peak.center) == (TRUCK, (row + down, col + along))
        assert told.peak.distance == pytest.approx(np.hypot(down, along))
        assert labels.centerness[0, 0, row, col] == pytest.approx(np.exp(-(told.peak.distance**2) / 9))
        center = labels.explain(0, *told.peak.center)
        assert "The nearest centre is that of actor 1303" in center.text
        assert "The nearest centre" not in labels.explain(0, 5, 5).text

    def test_boxes_one_over_the_other(self) -> None:
        """And rows whose number differs from frame to frame: each frame has its own that nobody sees."""
        one, two = (stacked([True] * 3 + [False] * extra) for extra in (1, 4))
        config = MotionLabelConfig(future_frames=1, draw_ego=False, protocol="clean")
        labels = motion_labels_from_boxes([one, two], np.zeros((4, 6)), config)
        for t, hidden in ((0, [8]), (1, [8, 9, 10, 11])):
            told = explain_cell_from_boxes(labels, [one, two], t, 100, 120)
            assert told.disagrees == ()
            assert told.painter.actor_id == 7
            assert [box.actor_id for box in told.covered] == [6, 5]
            assert [box.actor_id for box in told.left_out] == hidden
        unknown = motion_labels_from_boxes([one, two], np.zeros((4, 6)), config, valid=[True, True, True, False])
        told = explain_cell_from_boxes(unknown, [one, two], 1, 100, 120)
        assert (told.recorded, told.painter, told.disagrees) == (False, None, ())

    def test_every_cell_of_a_map_has_the_painter_that_boxes_give(self) -> None:
        """All cells of a small grid with boxes that overlap, reach beyond its border, and are thinner than a cell."""
        rng = np.random.default_rng(1)
        count = 9
        boxes = FrameBoxes(
            center=np.column_stack([rng.uniform(-6, 6, (count, 2)), np.zeros(count)]),
            size=np.column_stack([rng.uniform(0.2, 5, (count, 2)), np.ones(count)]),
            yaw=rng.uniform(-3, 3, count),
            actor_id=np.arange(count) + 5,
            category=np.zeros(count, dtype=int),
            visible=rng.random(count) < 0.7,
            ego_from_lidar=np.eye(4),
        )
        for protocol in ("released", "clean"):
            config = MotionLabelConfig(
                grid=BevGrid(x=(-6, 6, 0.5), y=(-5, 5, 0.5)), protocol=protocol, future_frames=1, draw_ego=False
            )
            labels = motion_labels_from_boxes([boxes, boxes], np.zeros((4, 6)), config)
            candidates = FrameCandidates.of([boxes, boxes], 0, config, np.eye(4), is_vehicle=True)
            for row in range(20):
                for col in range(24):
                    drawn = [each for each in candidates.covering((row, col)) if candidates.drawn[each]]
                    painter = int(candidates.key[drawn[-1]]) if drawn else None
                    assert painter == actor_at(labels, 0, row, col)


def stacked(visible: list[bool]) -> FrameBoxes:
    """Boxes at one place, with the ids 5, 6, …"""
    count = len(visible)
    return FrameBoxes(
        center=np.tile([10.0, 0, 0], (count, 1)),
        size=np.tile([4.0, 2, 1], (count, 1)),
        yaw=np.zeros(count),
        actor_id=np.arange(count) + 5,
        category=np.zeros(count, dtype=int),
        visible=np.array(visible),
        ego_from_lidar=np.eye(4),
    )


class TestQuirks:
    def test_every_switch_has_words(self) -> None:
        assert set(WORDS) == {*slip_names(), "drawn_when", "warp"}

    def test_cells_at_the_edge_of_a_box_that_lies_half_a_cell_off(self, small: DeepAccident) -> None:
        rules = replace(LABEL_PROTOCOLS["released"], half_cell_shift=False)
        labels = small.motion_labels(f"{EGO}/006")
        straight = small.motion_labels(f"{EGO}/006", MotionLabelConfig(protocol=rules))
        gone = {*painted(labels, 0, TRUCK)} - {*painted(straight, 0, TRUCK)}
        assert gone
        for cell in sorted(gone)[:4]:
            told = labels.explain(0, *cell)
            here, without = change(told, "half_cell_shift", "actor")
            assert (here, without) == (TRUCK, actor_at(straight, 0, *cell))

    def test_clean_labels_have_none(self, small: DeepAccident) -> None:
        labels = small.motion_labels(f"{EGO}/026", MotionLabelConfig(protocol="clean")).to_present()
        for t, row, col in some_cells(labels, np.random.default_rng(0))[::3]:
            assert labels.explain(t, row, col).quirks == ()

    def test_frames_after_the_recording(self, small: DeepAccident) -> None:
        for protocol, mark in (("released", 0), ("clean", 255)):
            labels = small.motion_labels(f"{EGO}/026", MotionLabelConfig(protocol=protocol)).to_present()
            told = labels.explain(3, 100, 100)
            assert (told.recorded, told.frame_sample, told.painter) == (False, None, None)
            assert told.values.segmentation == mark
            assert told.disagrees == ()
            assert "the recording ends before this frame" in told.text
            assert ("missing_frames_are_empty" in switches(told)) == (protocol == "released")

    def test_ids_of_an_earlier_sample(self, small: DeepAccident) -> None:
        labels = small.motion_labels(f"{EGO}/006", id_map={4711: 1, VAN: 9})
        told = labels.explain(0, *painted(labels, 0, VAN)[0])
        assert told.disagrees == ()
        assert change(told, "ids_kept_between_samples", "instance") == (9, 2)

    def test_an_own_box_that_stays_where_it_was(self, small: DeepAccident) -> None:
        labels = small.motion_labels(f"{EGO}/006", TURNED)
        told = [labels.explain(0, *cell) for cell in painted(labels, 0, OWN_BOX_ID)[::7]]
        assert any("own_box_not_augmented" in switches(each) for each in told)

    def test_untracked_rows_that_share_an_id(self, tmp_path: Path) -> None:
        """Two of them: their common centre lies between them."""
        release = DeepAccident(
            dataroot=tiny.write_tiny_release(
                tmp_path,
                lines_of=lambda *_: ["0 0", *(f"car {x} 9.0 -1 4.5 1.9 1.5 0 0 0 -1 9 True" for x in (5.0, 11.0))],
            ),
            verbose=False,
            workers=1,
        )
        labels = release.motion_labels(f"{POLE}/002", MotionLabelConfig(filter_invisible=False))
        row, col = painted(labels, 0, -1)[0]
        here, without = change(labels.explain(0, row, col), "untracked_share_an_id", "offset")
        assert here == tuple(labels.offset[0, :, row, col])
        assert without[1] == here[1] - 6


class TestDisagreement:
    def test_labels_that_were_changed(self, small: DeepAccident) -> None:
        labels = small.motion_labels(f"{EGO}/006")
        cell = painted(labels, 0, VAN)[4]
        other = np.where(labels.instance == labels.id_map[VAN], labels.id_map[TRUCK], labels.instance)
        told = replace(labels, instance=other).explain(0, *cell)
        assert told.disagrees == ("instance", "painter")
        assert told.painter is not None
        assert told.painter.actor_id == VAN
        assert "do not give what the labels have (instance, painter)" in told.text

    @pytest.mark.usefixtures("_no_quirks")
    def test_a_fault_in_the_drawing_is_not_repeated(self, small: DeepAccident, monkeypatch: pytest.MonkeyPatch) -> None:
        """Were the first box on top in place of the last, labels and their remake would agree, but not the painter."""

        def first_on_top(polygons: np.ndarray, shape: tuple[int, int], image: np.ndarray, images: int) -> np.ndarray:
            top = polygon_fill.topmost(polygons[::-1], shape, image[::-1], images)
            return np.where(top == 0, 0, len(polygons) + 1 - top).astype(np.int32)

        right = small.motion_labels(f"{EGO}/006")
        cells = [cell for cell in painted(right, 0, TRUCK)[::3] if right.explain(0, *cell).covered]
        monkeypatch.setattr(from_boxes, "topmost", first_on_top)
        wrong = small.motion_labels(f"{EGO}/006")
        assert actor_at(wrong, 0, *cells[0]) == UNDER
        assert wrong.explain(0, *cells[0]).disagrees == ("painter",)

    def test_centerness_that_no_sampling_gives(self, small: DeepAccident) -> None:
        labels = small.motion_labels(f"{EGO}/006").to_present()
        told = replace(labels, centerness=labels.centerness / 2).explain(2, *painted(labels, 2, VAN)[0])
        assert told.source.centerness is None
        assert told.disagrees == ("centerness",)


@pytest.mark.usefixtures("_no_quirks")
class TestPrediction:
    def test_a_perfect_one_finds_all(self, small: DeepAccident) -> None:
        labels = small.motion_labels(f"{EGO}/006").to_present()
        row, col = painted(labels, 2, VAN)[0]
        heads = MotionHeads.from_labels(labels)
        told = labels.explain(2, row, col, prediction=heads).prediction
        assert told is not None
        assert (told.outcome, told.cell, told.mostly, told.frames) == ("found", (row, col), VAN, 5)
        assert told.instance == predict_instances(heads, "motion").instance[2, row, col]
        assert told.probability == pytest.approx(1 / (1 + np.exp(-10)))
        assert told.offset == tuple(labels.offset[2, :, row, col])
        assert told.centerness == labels.centerness[2, 0, row, col]
        assert told.shared_cells == told.instance_cells == len(painted(labels, 2, VAN))

    @pytest.mark.parametrize("orientation", ORIENTATIONS)
    def test_in_any_orientation(self, small: DeepAccident, orientation: Orientation) -> None:
        labels = small.motion_labels(f"{EGO}/006").to_present()
        heads = MotionHeads.from_labels(labels).in_orientation(orientation)
        other = replace(heads, segmentation=-heads.segmentation, centerness=heads.centerness / 2)
        output = MotionOutput(grid=BevGrid(orientation=orientation), heads=(other, heads))
        row, col = painted(labels, 2, VAN)[0]
        turned = tuple(int(one) for one in place_in(row, col, labels.config.grid, "devkit", orientation))
        for prediction, count in ((heads, 1), (output, 2)):
            told = labels.explain(2, row, col, prediction=prediction).prediction
            assert told is not None
            assert (told.outcome, told.cell, told.mostly) == ("found", turned, VAN)
            assert len(told.probabilities) == count
            assert told.probability == told.probabilities[-1] > 0.99
            assert told.centerness == labels.centerness[2, 0, row, col]
            assert told.probabilities[0] > 0.99 or count == 2
            assert (told.offset, told.flow) == (
                tuple(labels.offset[2, :, row, col]),
                tuple(labels.flow[2, :, row, col]),
            )

    def test_instances_and_every_outcome(self, small: DeepAccident) -> None:
        labels = small.motion_labels(f"{EGO}/006").to_present()
        (row, col), (free, beside) = painted(labels, 1, VAN)[0], (3, 3)
        maps = np.zeros((2, 200, 200), dtype=np.int32)
        maps[1, free, beside] = 7
        end = labels.explain(2, row, col, prediction=maps).prediction
        assert (end.outcome, end.frames) == ("no such frame", 2)
        outcomes = [labels.explain(*at, prediction=maps).prediction for at in ((1, row, col), (1, free, beside),
                                                                              (1, 0, 0), (3, row, col))]  # fmt: skip
        assert [each.outcome for each in outcomes if each] == ["missed", "false alarm", "empty", "no such frame"]
        assert (outcomes[1].instance, outcomes[1].instance_cells, outcomes[1].mostly) == (7, 1, None)
        output = MotionOutput(grid=BevGrid(x=(0, 20, 0.5), y=(0, 20, 0.5)), instances=np.ones((3, 5, 40, 40), np.int32))
        assert labels.explain(0, 0, 0, prediction=output).prediction.outcome == "outside"
        inside = labels.explain(0, 100, 100, prediction=output).prediction
        assert (inside.cell, inside.outcome, inside.mostly) == ((0, 0), "found", None)
        both = np.zeros((2, 5, 200, 200), dtype=np.int32)
        both[0, 1, row, col] = 3
        both[1, 1] = np.where(labels.instance[1] == labels.id_map[VAN], 4, 0)
        both[1, 1][tuple(np.transpose(painted(labels, 1, WALKER)[:1]))] = 4
        output = MotionOutput(grid=BevGrid(), instances=both)
        last = labels.explain(1, row, col, prediction=output).prediction
        cells = len(painted(labels, 1, VAN))
        assert (last.instance, last.instance_cells, last.mostly, last.shared_cells) == (4, cells + 1, VAN, cells)
        linked = predict_instances(MotionHeads.from_labels(labels), "motion")
        assert labels.explain(1, row, col, prediction=linked).prediction.outcome == "found"

    def test_labels_in_their_own_frames_are_moved_to_the_prediction(self, small: DeepAccident) -> None:
        own = small.motion_labels(f"{EGO}/006", MotionLabelConfig(protocol="clean"))
        heads = MotionHeads.from_labels(own.to_present())
        cells = painted(own, 4, VAN)
        told = own.explain(4, *cells[len(cells) // 2], prediction=heads)
        assert told.prediction is not None
        assert told.prediction.outcome == "found"
        assert told.prediction.cell != told.cell
        everywhere = own.explain(4, *cells[0], prediction=np.ones((5, 200, 200), dtype=np.int32)).prediction
        assert (everywhere.outcome, everywhere.mostly, everywhere.shared_cells) == ("found", None, 0)

    @pytest.mark.parametrize("wrong", [np.zeros((5, 10, 10), int), "none", np.zeros((200, 200), int)])
    def test_what_is_no_prediction(self, small: DeepAccident, wrong: object) -> None:
        with pytest.raises(GeometryError, match="prediction: expected"):
            small.motion_labels(f"{EGO}/006").explain(0, 1, 1, prediction=wrong)
        heads = MotionHeads(**{name: np.zeros((5, axes, 9, 9)) for name, axes in
                               (("segmentation", 2), ("centerness", 1), ("offset", 2), ("flow", 2))})  # fmt: skip
        with pytest.raises(GeometryError, match="prediction: expected heads of 200 × 200 cells"):
            small.motion_labels(f"{EGO}/006").explain(0, 1, 1, prediction=heads)


class TestWithoutARelease:
    def test_labels_from_files_take_it_as_an_argument(self, small: DeepAccident, tmp_path: Path) -> None:
        token = f"{EGO}/006"
        write_label_files(small, tmp_path / "labels", [token], workers=1)
        stored = LabelFiles(tmp_path / "labels")[token]
        with pytest.raises(NotAvailableError, match=r"do not know their release .* call motion.explain_cell"):
            stored.explain(0, 1, 1)
        made = small.motion_labels(token)
        place = (0, *painted(made, 0, VAN)[0])
        assert explain_cell(stored, *place, dataset=small, sample=token) == made.explain(*place)
        again = explain_cell(stored.to_present(), *place, dataset=small, sample=small.get("sample", token))
        assert again == made.to_present().explain(*place)

    def test_labels_of_another_codes_loader(self, small: DeepAccident) -> None:
        made = small.motion_labels(f"{EGO}/006")
        labels = MotionLabels.from_batch(made.as_batch("beverse"), made.config, "beverse")
        told = explain_cell(labels, 0, *painted(made, 0, VAN)[0], dataset=small, sample=f"{EGO}/006")
        assert told.painter is not None
        assert (told.painter.actor_id, told.painter.label_id, told.disagrees) == (VAN, None, ())

    def test_pickled_labels_leave_the_release_behind(self, small: DeepAccident) -> None:
        labels = small.motion_labels(f"{EGO}/006")
        assert pickle.loads(pickle.dumps(labels)).origin is None
        assert len(pickle.dumps(labels)) < len(pickle.dumps(replace(labels, origin=None))) + 100

    def test_labels_of_another_sample(self, small: DeepAccident) -> None:
        labels = small.motion_labels(f"{EGO}/016")
        with pytest.raises(ConfigError, match=r"frames 1111110, .*/026 has 1111000 .* give the sample that"):
            explain_cell(labels, 0, 1, 1, dataset=small, sample=f"{EGO}/026")

    def test_boxes_alone(self) -> None:
        config = MotionLabelConfig(future_frames=1)
        boxes = FrameBoxes(
            center=np.array([[10.0, 0, 0]]), size=np.array([[4.0, 2, 1]]), yaw=np.zeros(1), actor_id=np.array([5]),
            category=np.array([1]), visible=np.array([True]), ego_from_lidar=np.eye(4),
        )  # fmt: skip
        labels = motion_labels_from_boxes([boxes, None], np.zeros((4, 6)), config, is_vehicle=False)
        told = explain_cell_from_boxes(labels, [boxes, None], 0, 100, 120, is_vehicle=False)
        assert told.painter is not None
        assert (told.painter.name, told.painter.annotation, told.sample) == ("truck 5", None, None)
        assert not explain_cell_from_boxes(labels, [boxes, None], 1, 100, 120, is_vehicle=False).recorded


@pytest.mark.parametrize("place", [(-1, 0, 0), (5, 0, 0), (0, 200, 0), (0, 0, -1), (0, 1.5, 0), (0, 0, "3")])
def test_what_is_no_cell(small: DeepAccident, place: tuple[int, int, int]) -> None:
    with pytest.raises(GeometryError, match=r"^(t|row|col): expected (0 to (4 \(0 is the present\)|199)|a whole)"):
        small.motion_labels(f"{EGO}/006").explain(*place)


def test_all_fields_are_json(small: DeepAccident) -> None:
    labels = small.motion_labels(f"{EGO}/006").to_present("bilinear")
    told = labels.explain(2, *painted(labels, 2, TRUCK)[3], prediction=MotionHeads.from_labels(labels))
    read = json.loads(json.dumps(told.to_dict()))
    assert read["text"] == told.text
    assert read["painter"]["annotation"] == told.painter.annotation
    assert read["prediction"]["outcome"] == "found"


class TestCommand:
    def run(self, *arguments: object) -> str:
        words = ["labels", "explain", *map(str, arguments)]
        result = CliRunner().invoke(deepaccident, words, catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return result.stdout

    def test_it_says_what_the_call_says(self, small: DeepAccident, tmp_path: Path) -> None:
        token = f"{EGO}/006"
        labels = small.motion_labels(token, MotionLabelConfig(protocol="clean", orientation="fiery"))
        own, present = labels, labels.to_present("bilinear")
        output = MotionOutput(grid=labels.config.grid, instances=present.instance[None].copy())
        with ResultsWriter(tmp_path / "results", "motion") as writer:
            writer.add(token, output)
        t, (row, col) = 2, painted(present, 2, TRUCK)[0]
        given = (small.dataroot, token, "--cell", f"{t},{row},{col}", "--protocol", "clean", "--orientation", "fiery")
        results = ("--results", tmp_path / "results", "--centerness", "bilinear")
        expected = present.explain(t, row, col, prediction=output)
        assert self.run(*given, *results) == f"{expected.text}\n"
        assert json.loads(self.run(*given, *results, "--json")) == json.loads(json.dumps(expected.to_dict()))
        assert self.run(*given, "--own-frames") == f"{own.explain(t, row, col).text}\n"

    @pytest.mark.parametrize("cell", ["", "1,2", "0,1,2,3", "a,b,c", "-1,2,3"])
    def test_what_is_no_cell(self, small: DeepAccident, cell: str) -> None:
        words = ["labels", "explain", str(small.dataroot), f"{EGO}/006", "--cell", cell]
        result = CliRunner().invoke(deepaccident, words)
        assert (result.exit_code, "expected T,ROW,COL such as 0,100,112" in result.output) == (2, True)

    def test_results_of_another_task(self, small: DeepAccident, tmp_path: Path) -> None:
        with ResultsWriter(tmp_path / "accidents.json", "accident") as writer:
            writer.add(f"{EGO}/006", [])
        with pytest.raises(NotAvailableError, match="holds accident results; --results takes those of motion"):
            self.run(small.dataroot, f"{EGO}/006", "--cell", "0,1,1", "--results", tmp_path / "accidents.json")
