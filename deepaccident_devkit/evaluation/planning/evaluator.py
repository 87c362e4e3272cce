"""`PlanningEvaluator`: plans by the definitions of four public codes, and by one for accidents."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.means import MeansEvaluator, MeansResult, Sums, table_rows
from deepaccident_devkit.evaluation.planning.cells import (
    CELL_PROTOCOLS,
    HORIZONS,
    STEP,
    STEPS,
    CellRules,
    cell_numbers,
    occupied,
    touching,
)
from deepaccident_devkit.evaluation.planning.clean import CleanPlanning, add_clean
from deepaccident_devkit.evaluation.planning.scene import (
    Plan,
    PlanningScene,
    planning_scene,
    steps_of,
    trivial_plans,
)
from deepaccident_devkit.evaluation.predictions import LONG_PATHS, LONGEST_PATH
from deepaccident_devkit.evaluation.task import Row
from deepaccident_devkit.geometry.box_arrays import corner_offsets
from deepaccident_devkit.support.arrays import BoolArray, IntArray
from deepaccident_devkit.taxonomy import FRAME_PERIOD

_Protocol = CleanPlanning | CellRules
PLANNING_PROTOCOLS: Final[Mapping[str, _Protocol]] = MappingProxyType(
    {"clean": CleanPlanning(), **CELL_PROTOCOLS}
)
GIVEN: Final = "given"
TRIVIAL: Final = ("recorded", "standing", "constant velocity", "full braking")
_MEAN: Final = "mean"
_LEFT_OUT_NOTE: Final = (
    "by these rules a plan that repeats the recorded accident has 0 % collisions: steps at which "
    "the recorded path touches, or is not recorded, are left out; left_out is their share"
)
_CONTINUED_NOTE: Final = "continued straight on: {plan} ending before 3 s"
_LARGE_YAW_NOTE: Final = (
    "suspicious: {plan} with a yaw beyond 2π; yaw is in radians, not in degrees"
)
_POINT_FAR_OFF_NOTE: Final = (
    "point_collision looks 25 m beside the path, as the code does; ignore it"
)
_BY_HORIZON: Final = tuple(f"{horizon} s" for horizon in HORIZONS)
BY_LEAD: Final = tuple(f"lead {lead:g} s" for lead in CleanPlanning().leads)


class PlanningResult(MeansResult):
    """Tables by horizon, and in `clean` by lead; rows are the evaluated and the trivial plans."""

    __slots__ = ()
    rows: ClassVar[tuple[Row, ...]] = table_rows(
        columns=(
            Row("avoided", "%", "higher"),
            Row("contact", "%"),
            Row("striking", "%"),
            Row("striking_twins", "%"),
            Row("lost_twins", "%", is_signed=True),
            Row("l2", "m"),
            Row("l2_mean", "m"),
            Row("collision", "%"),
            Row("point_collision", "%"),
            Row("left_out", "%", "neither"),
            Row("l2_endpoint", "m", is_headline=False),
            Row("impact_speed", "m/s", is_headline=False),
            Row("relative_speed", "m/s", is_headline=False),
            Row("prolonged", "%", "neither", is_headline=False),
            Row("struck", "%", is_headline=False),
            Row("struck_twins", "%", is_headline=False),
            Row("lost", "%", is_headline=False, is_signed=True),
            Row("lost_way", "m", is_headline=False, is_signed=True),
            Row("lost_way_twins", "m", is_headline=False, is_signed=True),
            Row("infeasible", "%", is_headline=False),
            Row("infeasible_twins", "%", is_headline=False),
            Row("braking_twins", "%", is_headline=False),
        ),
        main_tables=(*BY_LEAD, *_BY_HORIZON, _MEAN),
        main_row=GIVEN,
    )


class PlanningEvaluator(MeansEvaluator[PlanningResult]):
    """Collisions and errors of planned paths.

    For every protocol, rows of plans that need no planner stand beside the evaluated ones: a plan
    equal to the recorded accident has no collision by any of the four public definitions, as they
    leave out the steps at which the recorded path touches.

    >>> PlanningEvaluator("uniad").compute().samples
    0
    """

    task = "planning"
    description = "Evaluate planned paths: collisions, and distances from the recorded path."
    result_kinds: ClassVar[tuple[str, ...]] = ("planning",)
    protocols = PLANNING_PROTOCOLS
    result_class = PlanningResult
    main_numbers: ClassVar[tuple[str, ...]] = ("means/3 s/given/l2",)
    needs_whole_recordings = True
    needs_meta = True
    vehicles_only = True
    has_horizon = False

    protocol: _Protocol
    order: ClassVar[Sequence[str]] = (
        *(
            f"{role}{lead}{end}"
            for role in ("", "bystander, ")
            for end in ("", " to contact")
            for lead in BY_LEAD
        ),
        *_BY_HORIZON,
        _MEAN,
        GIVEN,
        *TRIVIAL,
    )

    def truth(self, dataset: Dataset, token: str, /, *_unused: Any) -> tuple[PlanningScene]:
        """Return what happens around the ego vehicle; public codes count complete recordings."""
        return (planning_scene(dataset, token, cut=isinstance(self.protocol, CleanPlanning)),)

    def update(self, token: str, plans: Iterable[Plan], scene: PlanningScene) -> None:
        """Count one sample.

        Args:
            token: Token of the sample.
            plans: One or more plans; the one with the highest score counts, the first of equal
                ones.
            scene: Scene from `planning_scene(dataset, token)`; for the rules of the public codes
                with `cut=False`.

        Raises:
            EvaluationError: there is no plan, it ends before the 3 s of the public codes, or the
                sample came before with other counts.
        """
        items: list[Any] = list(plans)
        non_plans = [item for item in items if not isinstance(item, Plan)]
        if non_plans or not items:
            found_name = type(non_plans[0]).__name__ if non_plans else "none"
            raise EvaluationError(f"{token}: expected one Plan or more, found {found_name}")
        plan = max(items, key=lambda item: item.score)
        rows = {GIVEN: plan, **trivial_plans(scene)}
        sums = Sums()
        sums.note(LONG_PATHS, plan.times[-1] > LONGEST_PATH)
        sums.note(_LARGE_YAW_NOTE, plan.yaw is not None and np.abs(plan.yaw).max() > 2 * np.pi)
        if isinstance(self.protocol, CleanPlanning):
            sums.note(_CONTINUED_NOTE, plan.times[-1] < HORIZONS[-1] - FRAME_PERIOD / 2)
            add_clean(sums, rows, scene, self.protocol)
        else:
            _add_cells(sums, token, rows, scene, self.protocol)
        self.add(token, sums.counts())


def _add_cells(
    sums: Sums, token: str, rows: Mapping[str, Plan], scene: PlanningScene, rules: CellRules
) -> None:
    """Add the numbers of plans by a public code's rules to the sums; raises EvaluationError."""
    sums.note(_LEFT_OUT_NOTE)
    if rules.point_far_off:
        sums.note(_POINT_FAR_OFF_NOTE)
    times = steps_of(STEP, STEPS * STEP)
    plan_end = rows[GIVEN].times[-1]
    if plan_end < times[-1] - FRAME_PERIOD / 2:
        raise EvaluationError(
            f"{token}: the plan ends after {plan_end:g} s; these rules look {times[-1]:g} s "
            "ahead: plan so far, or evaluate by the protocol clean"
        )
    frames = np.rint(times / FRAME_PERIOD).astype(np.int64)
    valid = frames < len(scene.recorded)
    cells = _occupied_cells(scene, frames, rules)
    ego = float(scene.size[0]), float(scene.size[1])
    paths = {name: plan.poses(times)[:, :2] for name, plan in rows.items()}
    touched = {name: touching(path, cells, ego, rules) for name, path in paths.items()}
    recorded = paths[TRIVIAL[0]]
    recorded_touched = touched[TRIVIAL[0]]
    for name, path in paths.items():
        numbers = cell_numbers(path, recorded, valid, (touched[name], recorded_touched), rules)
        for column, values in numbers.items():
            scaled = values if column.startswith("l2") else 100.0 * values
            for table, value in zip((*_BY_HORIZON, _MEAN), (*scaled, scaled.mean()), strict=True):
                sums.add(table, name, column, float(value))


def _occupied_cells(scene: PlanningScene, frames: IntArray, rules: CellRules) -> BoolArray:
    """Return the cells that others cover at frames (T,), shape (T, H, W); none after the end."""
    drawn = _drawn(scene, rules)
    nobody = np.zeros((0, 5))
    cells = []
    for frame in frames.tolist():
        boxes = scene.footprint[frame, drawn] if frame < len(scene.recorded) else nobody
        boxes = boxes[np.isfinite(boxes[:, 0])]
        corners = corner_offsets(boxes) + boxes[:, None, :2]
        cells.append(occupied(corners, rules))
    return np.stack(cells)


def _drawn(scene: PlanningScene, rules: CellRules) -> BoolArray:
    """Return the actors with boxes that the rules draw, a mask (A,)."""
    if rules.objects == "vehicles":
        return ~scene.is_pedestrian
    return scene.seen if rules.objects == "seen" else np.isfinite(scene.footprint[0, :, 0])
