"""`PlanningEvaluator`: plans under the rules of four public implementations, or our own `clean`."""

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.drawing import Drawing
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
from deepaccident_devkit.evaluation.planning.drawing import drawing_of_plan
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
PLAN_ROW: Final = "given"
TRIVIAL: Final = ("recorded", "standing", "constant velocity", "full braking")
_MEAN = "mean"
_LEFT_OUT_NOTE = (
    "by these rules a plan that repeats the recorded accident has 0 % collisions: steps at "
    "which the recorded path touches another actor, or has ended, are left out; `steps left out` "
    "is their share"
)
_CONTINUED_NOTE = "continued straight on: {plan} ending before 3 s"
_LARGE_YAW_NOTE = "suspicious: {plan} with a yaw beyond 2π; yaw is in radians, not in degrees"
_POINT_FAR_OFF_NOTE = (
    "ignore `collision rate of points`: it looks 25 m to the side of the path, as the released "
    "code does"
)
_BY_HORIZON = tuple(f"{horizon} s" for horizon in HORIZONS)
BY_LEAD: Final = tuple(f"lead {lead:g} s" for lead in CleanPlanning().leads)


class PlanningResult(MeansResult):
    """Tables by horizon; in the protocol `clean` also by lead time.

    Rows are the evaluated plan and the trivial plans.
    """

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
        main_row=PLAN_ROW,
    )


class PlanningEvaluator(MeansEvaluator[PlanningResult]):
    """Evaluator of planned paths: their collisions and errors.

    Every protocol also evaluates trivial plans that need no planner. Under all four public
    implementations, a plan that repeats the recorded accident has no collision, because steps at
    which the recorded path touches an object do not collide.

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
        PLAN_ROW,
        *TRIVIAL,
    )

    def truth(self, dataset: Dataset, token: str, /, *_unused: Any) -> tuple[PlanningScene]:
        """Return the scene around the ego, up to the cut.

        Under the rules of the public implementations it covers the whole recording.
        """
        cut = isinstance(self.protocol, CleanPlanning)
        return (planning_scene(dataset, token, cut=cut),)

    def update(self, token: str, plans: Iterable[Plan], scene: PlanningScene) -> None:
        """Count one sample.

        Args:
            token: Token of the sample.
            plans: One or more plans; only the one with the highest score counts (ties: the first).
            scene: Scene from `planning_scene(dataset, token)`; under the rules of the public
                implementations, pass `cut=False` to it.

        Raises:
            EvaluationError: If there is no plan, the sample was counted before with other counts,
                or under the rules of the public implementations the plan ends before 3 s.
        """
        items: list[Any] = list(plans)
        if not items:
            raise EvaluationError(f"{token}: expected one Plan or more, found none")
        for item in items:
            if not isinstance(item, Plan):
                found_name = type(item).__name__
                raise EvaluationError(f"{token}: expected one Plan or more, found {found_name}")
        best_plan: Plan = max(items, key=lambda plan: plan.score)
        plans_by_row = {PLAN_ROW: best_plan, **trivial_plans(scene)}
        plan_end = best_plan.times[-1]
        sums = Sums()
        sums.note(LONG_PATHS, plan_end > LONGEST_PATH)
        has_large_yaw = best_plan.yaw is not None and np.abs(best_plan.yaw).max() > 2 * np.pi
        sums.note(_LARGE_YAW_NOTE, has_large_yaw)
        if isinstance(self.protocol, CleanPlanning):
            sums.note(_CONTINUED_NOTE, plan_end < HORIZONS[-1] - FRAME_PERIOD / 2)
            add_clean(sums, plans_by_row, scene, self.protocol)
        else:
            _add_cell_numbers(sums, token, plans_by_row, scene, self.protocol)
        self.add(token, sums.counts())

    def drawing(self, _dataset: Dataset, _token: str, prediction: Any, /, *truth: Any) -> Drawing:
        """Describe the best plan, the recorded path, and the contact that the plan runs into."""
        (scene,) = truth
        best_plan = max(prediction, key=lambda plan: plan.score)
        return drawing_of_plan(best_plan, scene)


def _add_cell_numbers(
    sums: Sums, token: str, plans: Mapping[str, Plan], scene: PlanningScene, rules: CellRules
) -> None:
    """Add the numbers of plans under a public implementation's rules to the sums.

    Raises:
        EvaluationError: If the evaluated plan ends before the last step, at 3 s.
    """
    sums.note(_LEFT_OUT_NOTE)
    if rules.point_far_off:
        sums.note(_POINT_FAR_OFF_NOTE)
    times = steps_of(STEP, STEPS * STEP)
    plan_end = plans[PLAN_ROW].times[-1]
    if plan_end < times[-1] - FRAME_PERIOD / 2:
        raise EvaluationError(
            f"{token}: the plan ends after {plan_end:g} s; this protocol looks {times[-1]:g} s "
            "ahead: plan so far, or evaluate by the protocol clean"
        )
    frames = np.rint(times / FRAME_PERIOD).astype(np.int64)
    is_recorded = frames < len(scene.recorded)
    cells = _occupied_cells(scene, frames, rules)
    ego_size = float(scene.size[0]), float(scene.size[1])
    paths = {name: plan.poses(times)[:, :2] for name, plan in plans.items()}
    touched = {name: touching(path, cells, ego_size, rules) for name, path in paths.items()}
    recorded_path = paths[TRIVIAL[0]]
    recorded_touched = touched[TRIVIAL[0]]
    for row, path in paths.items():
        both_touched = touched[row], recorded_touched
        numbers = cell_numbers(path, recorded_path, is_recorded, both_touched, rules)
        for column, values in numbers.items():
            # distances are in metres, shares in percent
            scaled = values if column.startswith("l2") else 100.0 * values
            for table, value in zip(_BY_HORIZON, scaled, strict=True):
                sums.add(table, row, column, float(value))
            sums.add(_MEAN, row, column, float(scaled.mean()))


def _occupied_cells(scene: PlanningScene, frames: IntArray, rules: CellRules) -> BoolArray:
    """Mark the cells that other actors cover at frames (T,), shape (T, H, W) bool.

    After the recording's end no cell is covered.
    """
    is_drawn = _is_drawn(scene, rules)
    occupied_cells = np.zeros((len(frames), rules.size, rules.size), dtype=bool)
    for cells, frame in zip(occupied_cells, frames, strict=True):
        if frame < len(scene.recorded):
            footprints = scene.footprint[frame, is_drawn]
            footprints = footprints[np.isfinite(footprints[:, 0])]
            corners = corner_offsets(footprints) + footprints[:, None, :2]
            cells[:] = occupied(corners, rules)
    return occupied_cells


def _is_drawn(scene: PlanningScene, rules: CellRules) -> BoolArray:
    """Find the actors whose boxes the rules draw, shape (A,) bool."""
    if rules.objects == "vehicles":
        return ~scene.is_pedestrian
    if rules.objects == "seen":
        return scene.seen
    return np.isfinite(scene.footprint[0, :, 0])
