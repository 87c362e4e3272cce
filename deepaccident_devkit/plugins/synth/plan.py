"""The settings of a release, and its scenarios: accidents of each design and their twins, their names and splits."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Final, Literal, cast, get_args

import numpy as np

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth.spec import (
    DESIGN_NUMBERS,
    ScenarioSpec,
    SpecTemplate,
    View,
    draw,
    read_design,
    read_spec,
)
from deepaccident_devkit.plugins.synth.traffic.lifelike import (
    MISFILED,
    TRAFFICS,
    AccidentKind,
    as_kind,
    draw_kind,
    paths_join,
)
from deepaccident_devkit.selection.splits import Splits, split_records
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.tables.records import ScenarioRecord
from deepaccident_devkit.taxonomy import META_AGENTS, ROAD_TYPES, SPLITS, TOWNS, Layout

# Which sensors' files a release has: of all, those of accidents alone, images or clouds alone, or of none.
Sensors = Literal["all", "accidents", "cameras", "clouds", "none"]
# How a vehicle's sensors are mounted, and what their optics are.
RigName = Literal["released", "road"]
# Versions of the lifelike traffic, as in `lifelike.TRAFFICS`.
TrafficName = Literal["v1", "v2"]
MAX_FRAMES = 999
MIN_IMAGE_SIZE = (16, 9)
# The default size of images, pixels; small, because larger ones take long.
IMAGE_SIZE: Final = (480, 270)
# The size of the real images, pixels. The released code does not read the size: it assumes this one.
RELEASED_IMAGE_SIZE: Final = (1600, 900)
# All designs in the order of use: with and without traffic lights by turns, so that two pairs have both.
DESIGN_ROUND: Final = (1, 7, 2, 8, 3, 9, 4, 10, 5, 11, 6, 12)
# The designs in which a house on a street corner can hide the two colliding vehicles from each other to the end.
HIDDEN_DESIGN_ROUND: Final = (1, 7)
# From this many pairs on the official procedure splits a release; with fewer it would leave val and test empty.
OFFICIAL_FROM_PAIRS: Final = 12
# The fractional parts of its multiples fill [0, 1) evenly, for any number of them.
_GOLDEN_RATIO: Final = 0.6180339887498949
# The same is true of this number, independently.
_ROOT_OF_2: Final = 1.4142135623730951
# The largest share of its split that a mini split may hold.
_MINI_SHARE: Final = Fraction(1, 5)
_PLAN_STREAM: Final = 1
# Makes the plan's random numbers independent of those of the pair's scene.
_KIND_STREAM: Final = 2
# m/s: with a house on the kerb between them, slower cars would see each other earlier.
_HIDDEN_SPEEDS: Final = (12.0, 14.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class SynthConfig:
    """A synthetic release; checked when made, raises ConfigError.

    Attributes:
        scenarios: how many; they alternate between an accident and its normal twin.
        frames: recorded frames of each scenario, at 10 Hz: the last ones before its end. None records from the moment
            when the cars set off to the end, 40 to 100 frames.
        image_size: width and height of the camera images, pixels; None for 480×270, or 1600×900 with
            `for_released_code`. The real images have 1600×900. The released code assumes this size: with another
            one it computes wrong camera geometry.
        layout: `A`, all splits in one folder, or `B`, one folder for each split.
        seed: the same seed gives the same bytes (on the same machine with the same package versions).
        sensors: what to write besides labels, calib and meta: `all` sensors' files, with `accidents` those of
            accidents and none of their normal twins, with `cameras` the images alone (no point clouds, no BEV arrays),
            with `clouds` the point clouds alone, or `none`. Files that two of them write are the same. True and False
            mean `all` and `none`.
        sensor_step: sensors' files are written of every so many-th frame alone, counted back from the last one as
            samples are. With 5 there are all that the samples of `motion.samples` and their pasts need at 2 Hz, on a
            fifth of the disk. Labels, calib and meta are of all frames, and the same for any step.
        view: `hidden` puts a house on the kerb of the corner between ego and other, who drive a little faster than
            with the view `open`. They see each other only about a second before they meet; the infrastructure sees
            both all the time. With None the scenario files decide.
        designs: which of the paper's twelve are used by turns, in this order; empty for all (with the view `hidden`,
            for all in which a house can hide the two from each other).
        designed: whether accidents are clean: those of the designs, between drivers who err in nothing but the design.
            If not, accidents and traffic are as the real release has them. A `spec` or the view `hidden` asks for one
            certain accident, and that is always clean.
        unplanned: share of clean accidents that differ from the design: with a pedestrian or a third vehicle. It is 0
            where `spec` or the view `hidden` asks for one certain accident.
        spec: a scenario file (docs/synth.md) to use instead of the designs; every pair is one draw from it.
        traffic: Version of the accidents and of the traffic where they are not `designed`: `v2`, or `v1` for those of
            version 1.0.
        unlabelled_test: whether the test split lacks labels, BEV arrays and meta, as the real one does.
        rig: `released`, as vehicles of the release have it; or `road`, lower sensors, with the fields of view of
            nuScenes' cameras and images that are softer, noisier and of other colours: what stands for another dataset.
        exact: whether calib files are the same at each frame, and `num_lidar_pts` is the exact number of points. If
            not, both are a little wrong, as in the real release.
        decimals: to how many decimals the numbers of labels, calib and meta are rounded. Then they are the same bytes
            on any machine, since processors differ in digits that are gone. None for all digits.
        for_released_code: whether the released code must be able to read the release: images of 1600×900, layout `A`,
            a labelled test split, and split files under `split_txt_files/` too. Settings that contradict it are
            refused.
    """

    scenarios: int = 4
    frames: int | None = 40
    image_size: tuple[int, int] | None = None
    layout: Layout = "A"
    seed: int = 0
    sensors: Sensors | bool = "all"
    sensor_step: int = 1
    view: View | None = None
    designs: tuple[int, ...] = ()
    designed: bool = False
    unplanned: float = 0.1
    spec: Path | None = None
    traffic: TrafficName = "v2"
    unlabelled_test: bool = False
    rig: RigName = "released"
    exact: bool = False
    decimals: int | None = None
    for_released_code: bool = False

    def __post_init__(self) -> None:
        """Check every field."""
        _check_range("scenarios", self.scenarios, 1, None)
        if self.frames is not None:
            _check_range("frames", self.frames, 1, MAX_FRAMES)
        _check_range("seed", self.seed, 0, None)
        _check_range("sensor_step", self.sensor_step, 1, None)
        if self.decimals is not None:
            _check_range("decimals", self.decimals, 3, 15)  # with fewer a rotation would be none
        if isinstance(self.sensors, bool):
            object.__setattr__(self, "sensors", "all" if self.sensors else "none")
        words = {
            "layout": get_args(Layout),
            "sensors": get_args(Sensors),
            "view": (None, *get_args(View)),
        }
        words |= {"rig": get_args(RigName), "traffic": get_args(TrafficName)}
        settle_choices(self, words, error=ConfigError)
        if len(self.pixels) != 2:
            raise ConfigError(f"image_size: expected (width, height), found {self.image_size!r}")
        for name, value, least in zip(
            ("width", "height"), self.pixels, MIN_IMAGE_SIZE, strict=True
        ):
            _check_range(f"image_size: {name}", value, least, 8192)
        for design in self.designs:
            _check_range("designs", design, DESIGN_NUMBERS[0], DESIGN_NUMBERS[-1])
        if not 0 <= self.unplanned <= 1:
            raise ConfigError(
                f"unplanned: {self.unplanned} is not a share; choose a number from 0 to 1"
            )
        if self.spec is not None and self.designs:
            raise ConfigError(
                "spec, designs: a release is made of a scenario file or of designs; choose one of the two"
            )
        if self.for_released_code:
            self._check_for_released_code()

    @property
    def pixels(self) -> tuple[int, int]:
        """Width and height of the camera images that are made."""
        if self.image_size is not None:
            return self.image_size
        return RELEASED_IMAGE_SIZE if self.for_released_code else IMAGE_SIZE

    @property
    def lifelike(self) -> bool:
        """Whether accidents and traffic are as the real release has them."""
        return not self.designed and self.spec is None and self.view != "hidden"

    @property
    def design_round(self) -> tuple[int, ...]:
        """The designs that are used by turns."""
        return self.designs or (HIDDEN_DESIGN_ROUND if self.view == "hidden" else DESIGN_ROUND)

    def _check_for_released_code(self) -> None:
        """Refuse what the released code cannot read, or reads wrongly."""
        needed = {
            "image_size": (RELEASED_IMAGE_SIZE, self.pixels),
            "layout": ("A", self.layout),
            "unlabelled_test": (False, self.unlabelled_test),
        }
        for name, (wanted, found) in needed.items():
            if found != wanted:
                raise ConfigError(
                    f"{name}, for_released_code: the released code needs {wanted}, found {found} (docs/synth.md says "
                    "why); leave one of the two out"
                )


def _check_range(name: str, value: int, least: int, most: int | None) -> None:
    if value < least or (most is not None and value > most):
        span = f"from {least} to {most}" if most is not None else f"of at least {least}"
        raise ConfigError(f"{name}: {value} is not possible; choose a number {span}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioPlan:
    """One scenario to make.

    Attributes:
        pair: number of its pair, from 0; an accident and its normal twin share scene, name and split.
        accident: whether it is the accident.
        unplanned: whether the pair's accident differs from the designed one.
        name: such as `Town03_type001_subtype0001_scenario00024`.
        split: `train`, `val` or `test`.
        traits: what all its draws have in common.
        template: from which its scene is drawn.
        view: as the release asks for it; None for what the template says.
        kind: the kind of accident where all is as in the real release; None where it is as designed.
        misfiled: whether folder and meta disagree: an accident without a collision, or the reverse.
    """

    pair: int
    accident: bool
    unplanned: bool
    name: str
    split: str
    traits: "Traits"
    template: SpecTemplate
    view: View | None
    kind: AccidentKind | None = None
    misfiled: bool = False

    @property
    def design(self) -> int | None:
        """Which of the paper's twelve it is, if it is one."""
        return self.template.design

    @property
    def collides(self) -> bool:
        """Whether there is a collision in it."""
        return self.accident != self.misfiled

    @property
    def grazes(self) -> bool:
        """Whether a vehicle scrapes along another one beside the accident, the same in both scenarios of a pair."""
        return self.kind is not None and self.pair * _ROOT_OF_2 % 1 < self.kind.traffic.grazes

    @property
    def scenario_type(self) -> str:
        """Such as `type1_subtype1_accident`."""
        return f"type1_subtype{self.traits.subtype}_{'accident' if self.accident else 'normal'}"

    @property
    def token(self) -> str:
        """The scenario's token."""
        return f"{self.scenario_type}/{self.name}"

    def draw(self, rng: np.random.Generator) -> ScenarioSpec:
        """A draw from its template that has the plan's traits; the same random numbers give the same draw."""
        spec = draw(self.template, rng)
        while Traits.of(spec) != self.traits or (
            self.kind and self.kind.joins and not paths_join(spec)
        ):
            spec = draw(self.template, rng)
        if self.view is not None:
            spec = _seen(spec, self.view, rng)
        return spec if self.kind is None else as_kind(rng, spec, self.kind)


@dataclass(frozen=True, slots=True, kw_only=True)
class Traits:
    """The properties of a scenario that decide its folder and its split.

    Attributes:
        signalized: whether its junction has traffic lights.
        road_type: as the meta file names it.
        spawn_side: where other comes from, as the meta file names it.
    """

    signalized: bool
    road_type: str
    spawn_side: str

    @classmethod
    def of(cls, spec: ScenarioSpec) -> "Traits":
        """The traits of a draw."""
        four_way, three_way = ROAD_TYPES
        return cls(
            signalized=spec.road.signalized,
            road_type=four_way if spec.road.kind == "four-way" else three_way,
            spawn_side=spec.spawn_side,
        )

    @property
    def subtype(self) -> int:
        """1, signalised, or 2."""
        return 1 if self.signalized else 2


def plan_scenarios(config: SynthConfig) -> list[ScenarioPlan]:
    """The scenarios of a release: each accident, then its twin, with the designs by turns.

    A scenario file in which nobody is timed to meet gives only normal scenarios. Raises ConfigError: it cannot be read
    or simulated, or a hidden view is wanted where it is impossible.
    """
    own = None if config.spec is None else read_spec(config.spec)
    twins = own is None or own.meets
    plans = []
    for number in range(config.scenarios):
        pair, second = divmod(number, 2) if twins else (number, 1)
        designs = config.design_round
        template = own or read_design(designs[pair % len(designs)])
        plans.append(_plan(config, pair, template, accident=second == 0))
    split_of = {
        token: name
        for name, tokens in plan_splits(plans).by_name().items()
        if name in SPLITS
        for token in tokens
    }
    return [replace(plan, split=split_of[plan.token]) for plan in plans]


def plan_splits(plans: Sequence[ScenarioPlan]) -> Splits:
    """The split files of a release.

    The official procedure makes the splits, as `deepaccident split` does. With fewer than `OFFICIAL_FROM_PAIRS`
    pairs, the first goes to train, the second to val, the third to test, and of the later ones about 70, 15 and
    15 %.

    A mini split is what the procedure makes of its split (with fewer pairs: the first pairs of the split), with two
    differences. The procedure rounds a fifth of the split up or down, and leaves the mini split of a small split empty.
    Here it holds at most a fifth, but at least one pair, so that a loader of the mini splits finds something.
    """
    if len({plan.pair for plan in plans}) >= OFFICIAL_FROM_PAIRS:
        dealt = split_records([_record(plan) for plan in plans])
    else:
        train, val, test = (
            tuple(sorted(plan.token for plan in plans if _small_split(plan.pair) == split))
            for split in SPLITS
        )
        dealt = Splits(train=train, val=val, test=test, train_mini=train, val_mini=val)
    return replace(
        dealt,
        train_mini=_mini(plans, dealt.train, dealt.train_mini),
        val_mini=_mini(plans, dealt.val, dealt.val_mini),
    )


def _plan(
    config: SynthConfig, pair: int, template: SpecTemplate, *, accident: bool
) -> ScenarioPlan:
    rng = np.random.default_rng([config.seed, pair, _PLAN_STREAM])
    town = TOWNS[int(rng.integers(len(TOWNS)))]
    unplanned = rng.random() < config.unplanned and config.spec is None and config.view != "hidden"
    spec = draw(template, rng)
    traits, kind, misfiled = Traits.of(spec), None, False
    if config.lifelike:
        kind = draw_kind(
            np.random.default_rng([config.seed, pair, _KIND_STREAM]), spec, TRAFFICS[config.traffic]
        )
        of_folder = np.random.default_rng([config.seed, pair, _KIND_STREAM, accident])
        unplanned, misfiled = kind.pair is None, of_folder.random() < MISFILED[accident]
    if config.view == "hidden" and traits.spawn_side not in ("left", "right"):
        place = "" if config.spec is None else f"{template.place('actors')}: "
        others = "designs" if config.spec is None else "arms"
        raise ConfigError(
            f"{place}view: hidden needs the other vehicle to come from ego's left or right, but in '{template.name}' "
            f"it is on the side '{traits.spawn_side}'; choose other {others}, or the view open"
        )
    return ScenarioPlan(
        pair=pair,
        accident=accident,
        unplanned=unplanned,
        name=f"{town}_type001_subtype{traits.subtype:04d}_scenario{pair + 1:05d}",
        split=SPLITS[0],
        traits=traits,
        template=template,
        view=config.view,
        kind=kind,
        misfiled=misfiled,
    )


def _seen(spec: ScenarioSpec, view: View, rng: np.random.Generator) -> ScenarioSpec:
    """A scenario with another view; where a house hides ego and other, they drive faster, on a narrow road."""
    if view == "open":
        return replace(spec, view=view)
    actors = tuple(
        replace(actor, lane=0, max_speed=rng.uniform(*_HIDDEN_SPEEDS))
        if actor.role in ("ego", "other")
        else replace(actor, lane=0)
        for actor in spec.actors
    )
    return replace(spec, view=view, actors=actors, road=replace(spec.road, lanes=1))


def _small_split(pair: int) -> str:
    """The split of both scenarios of a pair: one pair to each split, of the later ones about 70, 15 and 15 %."""
    if pair < len(SPLITS):
        return SPLITS[pair]
    share = pair * _GOLDEN_RATIO % 1
    return "train" if share < 0.7 else "val" if share < 0.85 else "test"


def _mini(
    plans: Sequence[ScenarioPlan], split: Sequence[str], wanted: Collection[str]
) -> tuple[str, ...]:
    """The wanted whole pairs, as many as `_MINI_SHARE` of the split allows; if none, the split's smallest pair."""
    members, wanted = set(split), set(wanted)
    pairs: dict[int, list[str]] = {}
    for plan in plans:
        if plan.token in members:
            pairs.setdefault(plan.pair, []).append(plan.token)
    mini: list[str] = []
    for pair in pairs.values():
        if wanted.issuperset(pair) and len(mini) + len(pair) <= _MINI_SHARE * len(split):
            mini += pair
    if not mini and pairs:
        mini = min(pairs.values(), key=len)
    return tuple(sorted(mini))


def _record(plan: ScenarioPlan) -> ScenarioRecord:
    """The fields of a scenario's later record that the split procedure reads."""
    clean = not plan.unplanned and plan.template.meeting_roles == {"ego", "other"}
    pair = plan.kind.pair if plan.kind else ("ego", "other") if clean else None
    agents = (None, None) if pair is None else tuple(META_AGENTS[role] for role in pair)
    record = {
        "token": plan.token,
        "name": plan.name,
        "scenario_type": plan.scenario_type,
        "designed_accident": plan.accident,
        "weather": "",
        "collision": {"agents": agents} if plan.collides else None,
        "road_type": plan.traits.road_type,
        "spawn_side": plan.traits.spawn_side,
    }
    return cast("ScenarioRecord", record)
