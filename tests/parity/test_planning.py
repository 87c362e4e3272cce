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

PUBLIC = ("uniad", "stp3", "vad", "bev_planner")
BOX = (0.0, 0.0)
"""The agent's own, which these rules do not take."""
DRAW_WHAT_IS_THERE = ("uniad", "bev_planner")
"""They draw nothing at steps that are not recorded; the others draw what they are given."""
OLD_FILL = tuple(map(int, cv2.__version__.split(".")[:2])) < (4, 11)
"""OpenCV fills polygons at the border in another way since 4.11; the goldens are of a later one."""
FLOATS = "vad"
"""It makes corners of boxes in float32, which decides where one lies half-way between two cells."""


@functools.cache
def arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as archive:
        return dict(archive)


@pytest.fixture(scope="module")
def folder(pytestconfig: pytest.Config) -> Path:
    return Path(pytestconfig.getoption("golden")) / "planning"


def rasters(folder: Path, protocol: str) -> np.ndarray:
    return np.unpackbits(arrays(folder / "rasters.npz")[protocol], axis=-1).astype(bool)


def drawn(objects: np.ndarray, step: int, protocol: str) -> np.ndarray:
    """The corners of the objects of a sample that a code draws at a step."""
    kind, wanted = objects[:, 3], CELL_PROTOCOLS[protocol].objects
    present = (objects[:, 1] == 0) & (kind < 2)
    known = present & (objects[:, 4] > 1) if wanted == "seen" else present
    shown = (
        kind == 0
        if wanted == "vehicles"
        else (kind < 2) & np.isin(objects[:, 2], objects[known, 2])
    )
    rows = objects[shown & (objects[:, 1] == step)]
    footprints = rows[:, [5, 6, 8, 9, 7]]
    return corner_offsets(footprints) + footprints[:, None, :2]


@pytest.mark.parametrize("protocol", PUBLIC)
def test_the_rasters_are_those_of_the_code(folder: Path, protocol: str) -> None:
    inputs, stored = arrays(folder / "inputs.npz"), rasters(folder, protocol)
    assert len(stored)
    rules = CELL_PROTOCOLS[protocol]
    for sample, cells in enumerate(stored):
        objects = inputs["objects"][inputs["objects"][:, 0] == sample]
        for step in range(6):
            if protocol in DRAW_WHAT_IS_THERE and not inputs["valid"][sample, step]:
                assert not cells[step].any()
                continue
            corners = drawn(objects, step + 1, protocol)
            half_way = protocol == FLOATS and (np.abs(corners / rules.cell % 1 - 0.5) < 1e-5).any()
            off = occupied(corners, rules) != cells[step]
            assert off.sum() <= (25 if half_way or OLD_FILL else 0), (
                f"sample {sample}, step {step + 1}"
            )


def numbers_of(
    folder: Path, protocol: str
) -> tuple[list[np.ndarray], list[np.ndarray], list[dict[str, np.ndarray]]]:
    """What plan and recorded path touch in each sample of the stored rasters, and the numbers."""
    inputs, cells, rules = (
        arrays(folder / "inputs.npz"),
        rasters(folder, protocol),
        CELL_PROTOCOLS[protocol],
    )
    if protocol == "uniad":
        cells = cells | ~inputs["valid"][:, :, None, None]
    plans, trues, numbers = [], [], []
    for sample, (plan, true) in enumerate(zip(inputs["plan_xy"], inputs["gt_xy"], strict=True)):
        both = [path.astype(np.float64) for path in (plan, true)]
        found = [touching(path, cells[sample], BOX, rules) for path in both]
        plans.append(found[0])
        trues.append(found[1])
        numbers.append(cell_numbers(*both, inputs["valid"][sample], (found[0], found[1]), rules))
    return plans, trues, numbers


@pytest.mark.parametrize("protocol", PUBLIC)
def test_the_numbers_are_those_of_the_code(folder: Path, protocol: str) -> None:
    told = arrays(folder / "outputs.npz")
    plans, trues, numbers = numbers_of(folder, protocol)
    assert_array_equal([each[0] for each in plans], told[f"{protocol}_plan_hit"])
    assert_array_equal([each[0] for each in trues], told[f"{protocol}_gt_hit"])
    prefix = "" if protocol in ("uniad", "stp3") else "plan_"
    names = {"l2": "L2", "collision": "obj_box_col", "point_collision": "obj_col"}
    for field, name in names.items():
        found = np.array([each[field] for each in numbers])
        if protocol == "stp3":
            total, by_sample = told[f"stp3_total_{name}"], None
        elif protocol == "uniad":
            total, by_sample = told[f"uniad_total_{name}"][1::2], told[f"uniad_{name}"][:, 1::2]
        else:
            total, by_sample = (
                told[f"{protocol}_total_{prefix}{name}"],
                told[f"{protocol}_{prefix}{name}"],
            )
        assert_allclose(np.nanmean(found, axis=0), total, rtol=1e-6, atol=1e-6)
        if by_sample is not None:
            assert_allclose(found, by_sample, rtol=1e-6, atol=1e-6)
    if protocol == "bev_planner":
        assert_allclose(
            np.nanmean([each["l2"] for each in numbers]), told["bev_planner_avg_L2"], rtol=1e-6
        )
        assert_allclose(
            np.nanmean([each["collision"] for each in numbers]),
            told["bev_planner_avg_col"],
            rtol=1e-6,
        )


@pytest.mark.parametrize("protocol", PUBLIC)
def test_a_plan_equal_to_the_recorded_path_never_collides(folder: Path, protocol: str) -> None:
    inputs, cells, rules = (
        arrays(folder / "inputs.npz"),
        rasters(folder, protocol),
        CELL_PROTOCOLS[protocol],
    )
    touched = 0
    for sample, path in enumerate(inputs["gt_xy"].astype(np.float64)):
        found = touching(path, cells[sample], BOX, rules)
        touched += int(found[0].sum())
        numbers = cell_numbers(path, path, inputs["valid"][sample], (found, found), rules)
        points = [] if rules.point_far_off else [numbers["point_collision"]]
        for values in (numbers["l2"], numbers["collision"], *points):
            assert not np.nan_to_num(values).any()
    assert touched  # and it does touch


@pytest.mark.golden_cases("planning/clean_cases", "cases")
def test_contacts_are_those_of_closed_forms(golden) -> None:
    case = golden.entry
    poses = np.array(case["plan"])
    plan = Plan(times=np.arange(len(poses)) * case["plan_dt"], path=poses[:, :2], yaw=poses[:, 2])
    assert {each["dt"] for each in case["others"]} == {FRAME_PERIOD}
    frames = 1 + round(
        max([plan.times[-1] / FRAME_PERIOD, *(len(each["poses"]) - 1 for each in case["others"])])
    )
    others = np.full((frames, len(case["others"]), 5), np.nan)
    for number, each in enumerate(case["others"]):
        there = np.array(each["poses"])
        size = np.broadcast_to(each["box"], (len(there), 2))
        others[: len(there), number] = np.column_stack([there[:, :2], size, there[:, 2]])
    until = np.full(others.shape[1], (frames - 1) * FRAME_PERIOD)
    path = plan.poses(np.arange(frames) * FRAME_PERIOD)
    found = first_contacts(
        path, np.array(case["ego_box"]), others, np.zeros(others.shape[1]), until
    )
    told, ids = case["expected"], [each["id"] for each in case["others"]]
    assert [ids[at] for at in np.flatnonzero(found.overlapping)] == told.get(
        "overlap_at_present", []
    )
    times = np.where(found.overlapping, np.inf, found.time)
    first = int(np.argmin(times))
    if told["contact"] is None:
        assert np.isinf(times).all()
        return
    assert ids[first] == told["contact"]
    numbers = [times[first], found.speed[first], found.relative_speed[first]]
    assert_allclose(
        numbers, [told[name] for name in ("t", "ego_speed", "relative_speed")], atol=1e-6
    )


def test_the_definitions_disagree_as_the_page_says() -> None:
    """Sample 35 of our own goldens, in docs/protocols.md: one plan that drives through a car at 2.5
    s.
    """
    folder = Path(__file__).parents[1] / "data" / "golden" / "planning"
    found = {protocol: numbers_of(folder, protocol)[2][35] for protocol in PUBLIC}
    collisions = {protocol: (100 * each["collision"]).tolist() for protocol, each in found.items()}
    sixth = pytest.approx(100 / 6)
    assert collisions == {
        "uniad": [0] * 3,
        "stp3": [0, 0, sixth],
        "vad": [0, 0, sixth],
        "bev_planner": [0, 0, 100],
    }
    assert_allclose(found["uniad"]["l2"], [0.78, 2.28, 5.16], atol=0.005)
    for protocol in PUBLIC[1:]:
        assert_allclose(found[protocol]["l2"], [0.55, 1.15, 2.23], atol=0.005)
