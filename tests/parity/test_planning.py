"""The golden planning numbers (tests/data/golden/planning), within the tolerances of its README.

Rasters, hits and metrics are what the public code of UniAD, ST-P3, VAD and BEV-Planner gave; the
cases of `clean` are closed forms.
"""

import functools
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit.evaluation.planning import CELL_PROTOCOLS, Plan
from deepaccident_devkit.evaluation.planning.cells import cell_numbers, occupied, touching
from deepaccident_devkit.evaluation.planning.contacts import first_contacts
from deepaccident_devkit.geometry.box_arrays import corner_offsets
from deepaccident_devkit.taxonomy import FRAME_PERIOD

PUBLIC_PROTOCOLS = ("uniad", "stp3", "vad", "bev_planner")
UNUSED_BOX_SIZE = (0.0, 0.0)
"""The size of the agent's own box, which these rules do not read."""
DRAW_RECORDED_STEPS = ("uniad", "bev_planner")
"""Protocols that draw nothing at steps that are not recorded; the others draw all their input."""
FILLS_AS_BEFORE_4_11 = tuple(map(int, cv2.__version__.split(".")[:2])) < (4, 11)
"""Since 4.11 OpenCV fills the border of polygons differently; the golden rasters are newer."""
FLOAT32_PROTOCOL = "vad"
"""It computes box corners in float32, which matters half-way between two cells."""
MAX_TIED_CELLS = 25
"""The cells of a raster that may differ for one of these two reasons."""


@functools.cache
def read_arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as archive:
        return dict(archive)


@pytest.fixture(scope="module")
def folder(pytestconfig: pytest.Config) -> Path:
    return Path(pytestconfig.getoption("golden")) / "planning"


def read_rasters(folder: Path, protocol: str) -> np.ndarray:
    return np.unpackbits(read_arrays(folder / "rasters.npz")[protocol], axis=-1).astype(bool)


def drawn_corners(objects: np.ndarray, step: int, protocol: str) -> np.ndarray:
    """Return the corners of the objects of a sample that a code draws at a step."""
    kind = objects[:, 3]
    drawn_kinds = CELL_PROTOCOLS[protocol].objects
    is_known = (objects[:, 1] == 0) & (kind < 2)
    if drawn_kinds == "seen":
        is_known &= objects[:, 4] > 1

    if drawn_kinds == "vehicles":
        is_drawn = kind == 0
    else:
        is_drawn = (kind < 2) & np.isin(objects[:, 2], objects[is_known, 2])
    footprints = objects[is_drawn & (objects[:, 1] == step)][:, [5, 6, 8, 9, 7]]
    return corner_offsets(footprints) + footprints[:, None, :2]


@pytest.mark.parametrize("protocol", PUBLIC_PROTOCOLS)
def test_rasters_equal_the_codes(folder: Path, protocol: str) -> None:
    inputs = read_arrays(folder / "inputs.npz")
    rasters = read_rasters(folder, protocol)
    rules = CELL_PROTOCOLS[protocol]

    assert len(rasters)
    for sample, cells in enumerate(rasters):
        objects = inputs["objects"][inputs["objects"][:, 0] == sample]
        for step in range(6):
            if protocol in DRAW_RECORDED_STEPS and not inputs["valid"][sample, step]:
                assert not cells[step].any()
                continue
            corners = drawn_corners(objects, step + 1, protocol)
            is_half_way = np.abs(corners / rules.cell % 1 - 0.5) < 1e-5
            has_ties = protocol == FLOAT32_PROTOCOL and is_half_way.any()
            allowed = MAX_TIED_CELLS if has_ties or FILLS_AS_BEFORE_4_11 else 0
            differs = occupied(corners, rules) != cells[step]
            assert differs.sum() <= allowed, f"sample {sample}, step {step + 1}"


def measure_samples(
    folder: Path, protocol: str
) -> tuple[list[np.ndarray], list[np.ndarray], list[dict[str, np.ndarray]]]:
    """Return the contacts of plan and recorded path in each sample, and the metrics."""
    inputs = read_arrays(folder / "inputs.npz")
    rasters = read_rasters(folder, protocol)
    rules = CELL_PROTOCOLS[protocol]
    if protocol == "uniad":
        rasters = rasters | ~inputs["valid"][:, :, None, None]

    plan_contacts = []
    recorded_contacts = []
    metrics = []
    plans = inputs["plan_xy"].astype(np.float64)
    recorded = inputs["gt_xy"].astype(np.float64)
    for plan, path, cells, valid in zip(plans, recorded, rasters, inputs["valid"], strict=True):
        contacts = (
            touching(plan, cells, UNUSED_BOX_SIZE, rules),
            touching(path, cells, UNUSED_BOX_SIZE, rules),
        )
        plan_contacts.append(contacts[0])
        recorded_contacts.append(contacts[1])
        metrics.append(cell_numbers(plan, path, valid, contacts, rules))
    return plan_contacts, recorded_contacts, metrics


@pytest.mark.parametrize("protocol", PUBLIC_PROTOCOLS)
def test_metrics_equal_the_codes(folder: Path, protocol: str) -> None:
    outputs = read_arrays(folder / "outputs.npz")
    plan_contacts, recorded_contacts, metrics = measure_samples(folder, protocol)

    plan_hits = [contacts[0] for contacts in plan_contacts]
    recorded_hits = [contacts[0] for contacts in recorded_contacts]
    assert_array_equal(plan_hits, outputs[f"{protocol}_plan_hit"])
    assert_array_equal(recorded_hits, outputs[f"{protocol}_gt_hit"])

    prefix = "" if protocol in ("uniad", "stp3") else "plan_"
    names = {"l2": "L2", "collision": "obj_box_col", "point_collision": "obj_col"}
    for field, name in names.items():
        values = np.array([sample_metrics[field] for sample_metrics in metrics])
        total = outputs[f"{protocol}_total_{prefix}{name}"]
        if protocol == "uniad":
            total = total[1::2]
        assert_allclose(np.nanmean(values, axis=0), total, rtol=1e-6, atol=1e-6)
        if protocol == "stp3":
            continue
        by_sample = outputs[f"{protocol}_{prefix}{name}"]
        if protocol == "uniad":
            by_sample = by_sample[:, 1::2]
        assert_allclose(values, by_sample, rtol=1e-6, atol=1e-6)

    if protocol == "bev_planner":
        for field, name in {"l2": "avg_L2", "collision": "avg_col"}.items():
            mean = np.nanmean([sample_metrics[field] for sample_metrics in metrics])
            assert_allclose(mean, outputs[f"bev_planner_{name}"], rtol=1e-6)


@pytest.mark.parametrize("protocol", PUBLIC_PROTOCOLS)
def test_a_plan_equal_to_the_recorded_path_never_collides(folder: Path, protocol: str) -> None:
    inputs = read_arrays(folder / "inputs.npz")
    rasters = read_rasters(folder, protocol)
    rules = CELL_PROTOCOLS[protocol]
    fields = ["l2", "collision"]
    if not rules.point_far_off:
        fields.append("point_collision")

    num_touched = 0
    for sample, path in enumerate(inputs["gt_xy"].astype(np.float64)):
        contacts = touching(path, rasters[sample], UNUSED_BOX_SIZE, rules)
        num_touched += int(contacts[0].sum())
        metrics = cell_numbers(path, path, inputs["valid"][sample], (contacts, contacts), rules)
        for field in fields:
            assert not np.nan_to_num(metrics[field]).any()
    assert num_touched  # the recorded path does touch occupied cells


@pytest.mark.golden_cases("planning/clean_cases", "cases")
def test_contacts_equal_closed_forms(golden) -> None:
    case = golden.entry
    objects = case["others"]
    expected = case["expected"]
    plan_poses = np.array(case["plan"])
    plan_times = np.arange(len(plan_poses)) * case["plan_dt"]
    plan = Plan(times=plan_times, path=plan_poses[:, :2], yaw=plan_poses[:, 2])
    assert {vehicle["dt"] for vehicle in objects} == {FRAME_PERIOD}

    last_frames = [len(vehicle["poses"]) - 1 for vehicle in objects]
    frames = 1 + round(max([plan.times[-1] / FRAME_PERIOD, *last_frames]))
    boxes = np.full((frames, len(objects), 5), np.nan)
    for number, vehicle in enumerate(objects):
        poses = np.array(vehicle["poses"])
        size = np.broadcast_to(vehicle["box"], (len(poses), 2))
        boxes[: len(poses), number] = np.column_stack([poses[:, :2], size, poses[:, 2]])
    end_times = np.full(len(objects), (frames - 1) * FRAME_PERIOD)
    path = plan.poses(np.arange(frames) * FRAME_PERIOD)
    ego_box = np.array(case["ego_box"])
    contacts = first_contacts(path, ego_box, boxes, np.zeros(len(objects)), end_times)

    ids = [vehicle["id"] for vehicle in objects]
    overlapping_ids = [ids[index] for index in np.flatnonzero(contacts.overlapping)]
    assert overlapping_ids == expected.get("overlap_at_present", [])
    times = np.where(contacts.overlapping, np.inf, contacts.time)
    first = int(np.argmin(times))
    if expected["contact"] is None:
        assert np.isinf(times).all()
        return
    assert ids[first] == expected["contact"]
    assert_allclose(times[first], expected["t"], atol=1e-6)
    assert_allclose(contacts.speed[first], expected["ego_speed"], atol=1e-6)
    assert_allclose(contacts.relative_speed[first], expected["relative_speed"], atol=1e-6)


def test_the_definitions_disagree_as_the_page_says() -> None:
    """Compare sample 35 of our golden numbers, a plan that drives through a car at 2.5 s.

    docs/protocols.md shows these numbers.
    """
    folder = Path(__file__).parents[1] / "data" / "golden" / "planning"
    metrics = {protocol: measure_samples(folder, protocol)[2][35] for protocol in PUBLIC_PROTOCOLS}
    collisions_percent = {
        protocol: (100 * sample_metrics["collision"]).tolist()
        for protocol, sample_metrics in metrics.items()
    }

    sixth = pytest.approx(100 / 6)
    assert collisions_percent == {
        "uniad": [0] * 3,
        "stp3": [0, 0, sixth],
        "vad": [0, 0, sixth],
        "bev_planner": [0, 0, 100],
    }
    assert_allclose(metrics["uniad"]["l2"], [0.78, 2.28, 5.16], atol=0.005)
    for protocol in PUBLIC_PROTOCOLS[1:]:
        assert_allclose(metrics[protocol]["l2"], [0.55, 1.15, 2.23], atol=0.005)
