"""The settings of a release, and the plan of its scenarios with their names and splits."""

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
    apply_kind,
    draw_kind,
    paths_join,
)
from deepaccident_devkit.selection.splits import Splits, split_records
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.tables.records import ScenarioRecord
from deepaccident_devkit.taxonomy import META_AGENTS, ROAD_TYPES, SPLITS, TOWNS, Layout

Sensors = Literal["all", "accidents", "cameras", "clouds", "none"]
"""The sensors' files of a release: all, only of accidents, only images, only clouds, or none."""
RigName = Literal["released", "road"]
"""The mounting of a vehicle's sensors, and their optics."""
TrafficName = Literal["v1", "v2"]
"""Versions of the lifelike traffic, as in `lifelike.TRAFFICS`."""
MAX_FRAMES = 999
MIN_IMAGE_SIZE = (16, 9)
IMAGE_SIZE: Final = (480, 270)
"""The default size of images, pixels; small, because larger ones take long."""
RELEASED_IMAGE_SIZE: Final = (1600, 900)
"""The size of the real images, pixels. The released code does not read the size: it assumes it."""
DESIGN_ROUND: Final = (1, 7, 2, 8, 3, 9, 4, 10, 5, 11, 6, 12)
"""All designs in the order of use: with and without traffic lights in turn."""
HIDDEN_DESIGN_ROUND: Final = (1, 7)
"""The designs in which a house on a corner can hide the colliders from each other to the end."""
OFFICIAL_FROM_PAIRS: Final = 12
"""Smallest number of pairs that the official procedure splits without empty val and test splits."""
# The fractional parts of any number of its multiples fill [0, 1) evenly.
_GOLDEN_RATIO = 0.6180339887498949
# So do the multiples of this number, independently of the first.
_ROOT_OF_2 = 1.4142135623730951
# The largest share of its split that a mini split may hold.
_MINI_SHARE = Fraction(1, 5)
_PLAN_STREAM = 1
# Makes the plan's random numbers independent of the random numbers of the pair's scene.
_KIND_STREAM = 2
# Lowest and highest speed with a house on the kerb between ego and other, m/s; if they were slower,
# they would see each other earlier.
_HIDDEN_SPEEDS = (12.0, 14.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class SynthConfig:
    """The settings of a synthetic release.

    They are checked on construction; a wrong one raises ConfigError.

    Attributes:
        scenarios: How many; they alternate between an accident and its normal twin.
        frames: Recorded frames of each scenario, at 10 Hz: the last ones before its end. None
            records from the moment when the cars set off to the end, 40 to 100 frames.
        image_size: Width and height of the camera images, pixels; None for 480×270, or 1600×900
            with `for_released_code`. The real images have 1600×900. The released code assumes this
            size: with another one it computes wrong camera geometry.
        layout: `A`, all splits in one folder, or `B`, one folder for each split.
        seed: The same seed gives the same bytes (on the same machine with the same package
            versions).
        sensors: What to write besides labels, calib and meta: `all` sensors' files, with
            `accidents` only the files of accidents and not of their normal twins, with `cameras`
            only the images (no point clouds, no BEV arrays), with `clouds` only the point clouds,
            or `none`. Files that two of them write are the same. True and False mean `all` and
            `none`.
        sensor_step: Step between frames with sensors' files, counted back from the last frame as
            samples are. With 5 there are all files that the samples of `motion.samples` and their
            pasts need at 2 Hz, on a fifth of the disk. Labels, calib and meta are of all frames,
            and the same for any step.
        view: `hidden` puts a house on the kerb of the corner between ego and other, which drive a
            little faster than with the view `open`. They see each other only about a second before
            they meet; the infrastructure sees both all the time. With None the scenario files
            decide.
        designs: Numbers of the paper's designs, which are used in turn, in this order; empty for
            all twelve (with the view `hidden`, for all in which a house can hide the two from each
            other).
        designed: Whether accidents are clean: the accidents of the designs, between drivers who err
            in nothing but the design. If not, accidents and traffic are as the real release has
            them. A `spec` or the view `hidden` asks for one certain accident, and that is always
            clean.
        unplanned: Share of clean accidents that differ from the design: with a pedestrian or a
            third vehicle. It is 0 where `spec` or the view `hidden` asks for one certain accident.
        spec: Scenario file (docs/synth.md) to use instead of the designs; every pair is one draw
            from it.
        traffic: Version of the accidents and of the traffic where they are not `designed`: `v2`, or
            `v1` for the traffic of version 1.0.
        unlabelled_test: Whether the test split lacks labels, BEV arrays and meta, as the real one
            does.
        rig: `released`, as vehicles of the release have it; or `road`, lower sensors, with the
            fields of view of nuScenes' cameras and images that are softer, noisier and of other
            colours, as a stand-in for another dataset.
        exact: Whether calib files are the same at each frame, and `num_lidar_pts` is the exact
            number of points. If not, both are a little wrong, as in the real release.
        decimals: Number of decimals to which the numbers of labels, calib and meta are rounded.
            Then they are the same bytes on any machine, because the digits in which processors
            differ are gone. None for all digits.
        for_released_code: Whether the released code must be able to read the release: images of
            1600×900, layout `A`, a labelled test split, and split files under `split_txt_files/`
            too. Settings that contradict it are refused.
    """

    # size and layout of the release
    scenarios: int = 4
    frames: int | None = 40
    image_size: tuple[int, int] | None = None
    layout: Layout = "A"
    seed: int = 0
    # files of sensors
    sensors: Sensors | bool = "all"
    sensor_step: int = 1
    # accidents and traffic
    view: View | None = None
    designs: tuple[int, ...] = ()
    designed: bool = False
    unplanned: float = 0.1
    spec: Path | None = None
    traffic: TrafficName = "v2"
    # likeness to the real release
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
            # With fewer decimals a rotation would be none.
            _check_range("decimals", self.decimals, 3, 15)
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
        sides = zip(("width", "height"), self.pixels, MIN_IMAGE_SIZE, strict=True)
        for name, length, min_length in sides:
            _check_range(f"image_size: {name}", length, min_length, 8192)
        for design in self.designs:
            _check_range("designs", design, DESIGN_NUMBERS[0], DESIGN_NUMBERS[-1])
        if not 0 <= self.unplanned <= 1:
            raise ConfigError(
                f"unplanned: {self.unplanned} is not a share; choose a number from 0 to 1"
            )
        if self.spec is not None and self.designs:
            raise ConfigError(
                "spec, designs: a release is made either from a scenario file or from designs; "
                "choose one of the two"
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
        certain_accident = self.spec is not None or self.view == "hidden"
        return not self.designed and not certain_accident

    @property
    def design_round(self) -> tuple[int, ...]:
        """The designs that are used in turn."""
        if self.designs:
            return self.designs
        return HIDDEN_DESIGN_ROUND if self.view == "hidden" else DESIGN_ROUND

    def _check_for_released_code(self) -> None:
        """Refuse settings that the released code cannot read, or reads wrongly."""
        values_by_name = {
            "image_size": (RELEASED_IMAGE_SIZE, self.pixels),
            "layout": ("A", self.layout),
            "unlabelled_test": (False, self.unlabelled_test),
        }
        for name, (expected, value) in values_by_name.items():
            if value != expected:
                raise ConfigError(
                    f"{name}, for_released_code: the released code needs {expected}, found {value} "
                    "(docs/synth.md explains why); remove one of the two"
                )


def _check_range(name: str, value: int, minimum: int, maximum: int | None) -> None:
    """Raise ConfigError unless a number is within its limits."""
    if value < minimum or (maximum is not None and value > maximum):
        span = f"of at least {minimum}"
        if maximum is not None:
            span = f"from {minimum} to {maximum}"
        raise ConfigError(f"{name}: {value} is not possible; choose a number {span}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioPlan:
    """One scenario to make.

    Attributes:
        pair: Number of its pair, from 0; an accident and its normal twin share scene, name and
            split.
        accident: Whether it is the accident.
        unplanned: Whether the pair's accident differs from the designed one.
        name: Name, such as `Town03_type001_subtype0001_scenario00024`.
        split: `train`, `val` or `test`.
        traits: Properties that all its draws have in common.
        template: Template from which its scene is drawn.
        view: View that the release asks for; None for the template's own view.
        kind: Kind of accident in a lifelike release; None in a designed one.
        misfiled: Whether folder and meta disagree: an accident without a collision, or the reverse.
    """

    # identity
    pair: int
    accident: bool
    unplanned: bool
    name: str
    split: str
    # scene
    traits: "Traits"
    template: SpecTemplate
    view: View | None
    # likeness to the real release
    kind: AccidentKind | None = None
    misfiled: bool = False

    @property
    def design(self) -> int | None:
        """Number of the paper's design, if it is one of the twelve."""
        return self.template.design

    @property
    def collides(self) -> bool:
        """Whether there is a collision in it."""
        return self.accident != self.misfiled

    @property
    def grazes(self) -> bool:
        """Whether a vehicle sideswipes another one in addition to the accident.

        The value is the same for both scenarios of a pair.
        """
        if self.kind is None:
            return False
        share = self.pair * _ROOT_OF_2 % 1
        return share < self.kind.traffic.grazes

    @property
    def scenario_type(self) -> str:
        """Type, such as `type1_subtype1_accident`."""
        if self.accident:
            outcome = "accident"
        else:
            outcome = "normal"
        return f"type1_subtype{self.traits.subtype}_{outcome}"

    @property
    def token(self) -> str:
        """Token of the scenario."""
        return f"{self.scenario_type}/{self.name}"

    def draw(self, rng: np.random.Generator) -> ScenarioSpec:
        """Draw from the template until a draw has the plan's traits.

        The same random numbers give the same draw.
        """
        spec = draw(self.template, rng)
        while not self._fits(spec):
            spec = draw(self.template, rng)
        if self.view is not None:
            spec = _change_view(spec, self.view, rng)
        if self.kind is None:
            return spec
        return apply_kind(rng, spec, self.kind)

    def _fits(self, spec: ScenarioSpec) -> bool:
        """Return whether a draw has the plan's traits, and paths that fit its kind of accident."""
        if Traits.of(spec) != self.traits:
            return False
        needs_joining_paths = self.kind is not None and self.kind.joins
        return not needs_joining_paths or paths_join(spec)


@dataclass(frozen=True, slots=True, kw_only=True)
class Traits:
    """The properties of a scenario that decide its folder and its split.

    Attributes:
        signalized: Whether its junction has traffic lights.
        road_type: Type of the road in the meta file's words.
        spawn_side: Side from which other comes in the meta file's words.
    """

    signalized: bool
    road_type: str
    spawn_side: str

    @classmethod
    def of(cls, spec: ScenarioSpec) -> "Traits":
        """Return the traits of a draw."""
        four_way, three_way = ROAD_TYPES
        return cls(
            signalized=spec.road.signalized,
            road_type=four_way if spec.road.kind == "four-way" else three_way,
            spawn_side=spec.spawn_side,
        )

    @property
    def subtype(self) -> int:
        """The subtype: 1 for a signalised junction, otherwise 2."""
        return 1 if self.signalized else 2


def plan_scenarios(config: SynthConfig) -> list[ScenarioPlan]:
    """Plan a release's scenarios: each accident, then its twin, with one design after another.

    A scenario file without a pair that is timed to meet gives only normal scenarios.

    Raises:
        ConfigError: The scenario file cannot be read or simulated, or the release asks for a hidden
            view where it is impossible.
    """
    own_template = None
    if config.spec is not None:
        own_template = read_spec(config.spec)
    has_twins = own_template is None or own_template.meets
    plans = []
    for number in range(config.scenarios):
        pair = number
        accident = False
        if has_twins:
            pair = number // 2
            accident = number % 2 == 0
        designs = config.design_round
        template = own_template or read_design(designs[pair % len(designs)])
        plans.append(_plan_scenario(config, pair, template, accident=accident))
    split_by_token = {}
    for name, tokens in plan_splits(plans).by_name().items():
        if name in SPLITS:
            split_by_token.update(dict.fromkeys(tokens, name))
    return [replace(plan, split=split_by_token[plan.token]) for plan in plans]


def plan_splits(plans: Sequence[ScenarioPlan]) -> Splits:
    """Plan the split files of a release.

    The official procedure makes the splits, as `deepaccident split` does. With fewer than
    `OFFICIAL_FROM_PAIRS` pairs, the first goes to train, the second to val, the third to test, and
    of the later ones about 70, 15 and 15 %.

    A mini split is the procedure's mini split of its split (with fewer pairs: the first pairs of
    the split), with two differences. The procedure rounds a fifth of the split up or down, and
    leaves the mini split of a small split empty. Here it holds at most a fifth, but at least one
    pair, so that a loader of the mini splits finds something.
    """
    if len({plan.pair for plan in plans}) >= OFFICIAL_FROM_PAIRS:
        splits = split_records([_make_record(plan) for plan in plans])
    else:
        tokens_by_split: dict[str, list[str]] = {split: [] for split in SPLITS}
        for plan in plans:
            tokens_by_split[_choose_small_split(plan.pair)].append(plan.token)
        train, val, test = (tuple(sorted(tokens)) for tokens in tokens_by_split.values())
        splits = Splits(train=train, val=val, test=test, train_mini=train, val_mini=val)
    return replace(
        splits,
        train_mini=_choose_mini_split(plans, splits.train, splits.train_mini),
        val_mini=_choose_mini_split(plans, splits.val, splits.val_mini),
    )


def _plan_scenario(
    config: SynthConfig, pair: int, template: SpecTemplate, *, accident: bool
) -> ScenarioPlan:
    """Plan one scenario; its split is still open."""
    rng = np.random.default_rng([config.seed, pair, _PLAN_STREAM])
    town = TOWNS[int(rng.integers(len(TOWNS)))]
    unplanned = rng.random() < config.unplanned and config.spec is None and config.view != "hidden"
    spec = draw(template, rng)
    traits = Traits.of(spec)
    kind = None
    misfiled = False
    if config.lifelike:
        kind_rng = np.random.default_rng([config.seed, pair, _KIND_STREAM])
        kind = draw_kind(kind_rng, spec, TRAFFICS[config.traffic])
        unplanned = kind.pair is None
        folder_rng = np.random.default_rng([config.seed, pair, _KIND_STREAM, accident])
        misfiled = folder_rng.random() < MISFILED[accident]
    if config.view == "hidden" and traits.spawn_side not in ("left", "right"):
        location = ""
        others = "designs"
        if config.spec is not None:
            location = f"{template.place('actors')}: "
            others = "arms"
        raise ConfigError(
            f"{location}view: hidden needs the other vehicle to come from ego's left or right, "
            f"but in '{template.name}' it is on the side '{traits.spawn_side}'; "
            f"choose other {others}, or the view open"
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


def _change_view(spec: ScenarioSpec, view: View, rng: np.random.Generator) -> ScenarioSpec:
    """Return a scenario with another view.

    Where a house hides ego and other, they drive faster, on a narrow road.
    """
    if view == "open":
        return replace(spec, view=view)
    actors = []
    for actor in spec.actors:
        max_speed = actor.max_speed
        if actor.role in ("ego", "other"):
            max_speed = rng.uniform(*_HIDDEN_SPEEDS)
        actors.append(replace(actor, lane=0, max_speed=max_speed))
    narrow_road = replace(spec.road, lanes=1)
    return replace(spec, view=view, actors=tuple(actors), road=narrow_road)


def _choose_small_split(pair: int) -> str:
    """Return the split of both scenarios of a pair in a small release.

    Each split gets one pair; of the later ones about 70, 15 and 15 %.
    """
    if pair < len(SPLITS):
        return SPLITS[pair]
    share = pair * _GOLDEN_RATIO % 1
    if share < 0.7:
        return "train"
    return "val" if share < 0.85 else "test"


def _choose_mini_split(
    plans: Sequence[ScenarioPlan], split: Sequence[str], candidates: Collection[str]
) -> tuple[str, ...]:
    """Choose the pairs of a mini split.

    Args:
        plans: All scenarios.
        split: Tokens of the split.
        candidates: Tokens of the mini split before it is limited.

    Returns:
        Sorted tokens of complete pairs of candidates, as many as `_MINI_SHARE` of the split allows;
        if none, of the split's smallest pair.
    """
    members = set(split)
    candidates = set(candidates)
    tokens_by_pair: dict[int, list[str]] = {}
    for plan in plans:
        if plan.token in members:
            tokens_by_pair.setdefault(plan.pair, []).append(plan.token)
    max_tokens = _MINI_SHARE * len(split)
    mini: list[str] = []
    for tokens in tokens_by_pair.values():
        fits = len(mini) + len(tokens) <= max_tokens
        if candidates.issuperset(tokens) and fits:
            mini += tokens
    if not mini and tokens_by_pair:
        mini = min(tokens_by_pair.values(), key=len)
    return tuple(sorted(mini))


def _make_record(plan: ScenarioPlan) -> ScenarioRecord:
    """Return the fields of a scenario's later record that the split procedure reads."""
    pair = None
    if plan.kind:
        pair = plan.kind.pair
    elif not plan.unplanned and plan.template.meeting_roles == {"ego", "other"}:
        pair = ("ego", "other")
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
