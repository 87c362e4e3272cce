"""`write_small_release`: writes a complete release of a few hundred kB, with all file types."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.release import (
    Collision,
    Meta,
    ScenarioFolder,
    write_meta,
    write_split_file,
)
from deepaccident_devkit.release.store import real_path
from deepaccident_devkit.support.files import check_free, replacing_folder
from deepaccident_devkit.support.text import choices, settle_choices
from deepaccident_devkit.taxonomy import (
    AGENTS,
    BEV_CAMERA,
    CHANNELS,
    MINI_SPLITS,
    SPLITS,
    TIMES_OF_DAY,
    WARM_UP_FRAMES,
    WEATHERS,
    AgentName,
    Layout,
)
from deepaccident_devkit.testing.scene import AGENT_IDS, PAIR, Recorder, SmallScene, small_scene

_MAX_FRAMES = 100
_MIN_IMAGE_SIZE = (16, 9)
_MAX_IMAGE_SIZE = (1600, 900)


@dataclass(frozen=True, slots=True, kw_only=True)
class SmallRelease:
    """The options of a small release; ConfigError is raised if one is not allowed.

    Attributes:
        layout: `A` for all splits in one folder, or `B` for one folder per split.
        frames: Number of recorded frames per scenario, at 10 Hz; with three, the release has less
            than 1 MB.
        splits: Splits to make: `train` (an accident and its normal twin, with traffic lights),
            `val` (an accident, without traffic lights) and `test` (a normal scenario without
            labels, BEV arrays and meta, as published).
        agents: Agents that record.
        channels: Sensors that have files; if empty, there are only labels, calib and meta.
        image_size: Width and height of the images in pixels.
        seed: Seed for positions in the town, speeds and weather; equal seeds yield equal values.
    """

    layout: Layout = "A"
    frames: int = 3
    splits: tuple[str, ...] = SPLITS
    agents: tuple[AgentName, ...] = AGENTS
    channels: tuple[str, ...] = CHANNELS
    image_size: tuple[int, int] = _MIN_IMAGE_SIZE
    seed: int = 0

    def __post_init__(self) -> None:
        """Check every field; convert lists to tuples, so that equal options have equal hashes."""
        object.__setattr__(self, "image_size", _as_tuple("image_size", self.image_size))
        settle_choices(self, {"layout": get_args(Layout)}, error=ConfigError)
        for name, known in (("splits", SPLITS), ("agents", AGENTS), ("channels", CHANNELS)):
            value = getattr(self, name)
            empty = name == "channels"
            names = choices(name, value, known, empty=empty, error=ConfigError)
            object.__setattr__(self, name, names)
        if not 1 <= self.frames <= _MAX_FRAMES:
            raise ConfigError(f"frames: expected 1 to {_MAX_FRAMES}, found {self.frames}")
        if self.seed < 0:
            raise ConfigError(f"seed: expected a whole number from 0, found {self.seed}")
        if len(self.image_size) != 2:
            raise ConfigError(f"image_size: expected (width, height), found {self.image_size}")
        sides = zip(_MIN_IMAGE_SIZE, self.image_size, _MAX_IMAGE_SIZE, strict=True)
        for minimum, side, maximum in sides:
            if not minimum <= side <= maximum:
                raise ConfigError(
                    f"image_size: expected width and height from {_MIN_IMAGE_SIZE} to "
                    f"{_MAX_IMAGE_SIZE}, found {self.image_size}"
                )


def _as_tuple(name: str, value: object) -> tuple[object, ...]:
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise ConfigError(f"{name}: expected a tuple or a list, found {value!r}")
    return tuple(value)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Story:
    """One scenario of the release; twins have the same name and the same random values."""

    split: str
    scenario_type: str
    name: str

    @property
    def token(self) -> str:
        return f"{self.scenario_type}/{self.name}"

    @property
    def accident(self) -> bool:
        return self.scenario_type.endswith("_accident")

    @property
    def published(self) -> bool:
        """Whether its labels, BEV arrays and meta are published; the test split lacks them."""
        return self.split != "test"

    @property
    def number(self) -> int:
        """The number at the end of the name."""
        digits = re.sub(r".*scenario", "", self.name)
        return int(digits)


_STORIES = (
    _Story(
        split="train",
        scenario_type="type1_subtype1_accident",
        name="Town03_type001_subtype0001_scenario00001",
    ),
    _Story(
        split="train",
        scenario_type="type1_subtype1_normal",
        name="Town03_type001_subtype0001_scenario00001",
    ),
    _Story(
        split="val",
        scenario_type="type1_subtype2_accident",
        name="Town05_type001_subtype0002_scenario00002",
    ),
    _Story(
        split="test",
        scenario_type="type1_subtype2_normal",
        name="Town10HD_type001_subtype0002_scenario00003",
    ),
)


def write_small_release(out: Path, config: SmallRelease | None = None) -> Path:
    """Write a healthy release of less than 1 MB; return its folder.

    It needs neither a generator nor a GPU. `deepaccident validate --deep` finds no fault in it.
    With default options it takes a second or two; with `SmallRelease(channels=())`, a tenth of it.

    Args:
        out: Folder to make; it must be empty, or not exist yet.
        config: Options of the release; `SmallRelease()` if None.

    Raises:
        ConfigError: If `out` is a file or is not empty.
    """
    config = config or SmallRelease()
    check_free(out)
    stories = [story for story in _STORIES if story.split in config.splits]
    with replacing_folder(out) as root:
        for story in stories:
            _write_scenario(root, story, config)
        _write_splits(root, stories)
    return out


def _write_scenario(root: Path, story: _Story, config: SmallRelease) -> None:
    split_folder = story.split if config.layout == "B" else ""
    folder = ScenarioFolder(root, split_folder, story.scenario_type, story.name, config.agents)
    rng = np.random.default_rng([config.seed, story.number])
    scene = small_scene(rng, frames=config.frames, accident=story.accident)
    meta = _meta(rng, scene, accident=story.accident)
    if story.published:
        write_meta(real_path(folder.meta_path), meta)
    channels = [channel for channel in config.channels if story.published or channel != BEV_CAMERA]
    for agent in config.agents:
        for frame in range(1, config.frames + 1):
            recorder = Recorder(folder, scene, agent, frame, config.image_size)
            recorder.write_calib()
            if story.published:
                recorder.write_label()
            for channel in channels:
                recorder.write_channel(channel)


def _meta(rng: np.random.Generator, scene: SmallScene, *, accident: bool) -> Meta:
    weather = rng.choice(WEATHERS)
    time_of_day = rng.choice(TIMES_OF_DAY)
    impact = rng.uniform(2000.0, 9000.0)
    users = {user.actor_id: user for user in scene.users}
    ids = (AGENT_IDS[AGENTS.index(PAIR[0])], AGENT_IDS[AGENTS.index(PAIR[1])])
    collision = Collision(
        ids=ids,
        classes=(users[ids[0]].category, users[ids[1]].category),
        impact=float(impact),
        spawn_relation="same",
        contact_side="front_side",
        agents=PAIR,
    )
    return Meta(
        weather=str(weather),
        time_of_day=str(time_of_day),
        collision=collision if accident else None,
        simulated_frames=scene.frames + WARM_UP_FRAMES,
        agent_ids=AGENT_IDS,
        road_type="four-way junction",
        spawn_side="right",
        ego_direction="straight",
        other_direction="straight",
        planned_agents=None if accident else PAIR,
    )


def _write_splits(root: Path, stories: Sequence[_Story]) -> None:
    """Write all split files, even empty ones; the mini splits contain all of train and val."""
    for split in (*SPLITS, *MINI_SPLITS):
        full_split = split.removesuffix("_mini")
        tokens = [story.token for story in stories if story.split == full_split]
        write_split_file(root / f"{split}.txt", tokens)
