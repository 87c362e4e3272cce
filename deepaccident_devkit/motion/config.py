"""`MotionLabelConfig`: what labels are drawn of, how far and how, with the presets that papers name."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final

from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import Orientation
from deepaccident_devkit.motion.augmentation import Augmentation
from deepaccident_devkit.motion.protocols import LABEL_PROTOCOLS, LabelProtocol, label_protocol
from deepaccident_devkit.v2x import AgentConfig, Agents

_STEPS_PER_SECOND: Final = 2
_BYTE: Final = 255


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionLabelConfig:
    """What motion labels show; the defaults are the released ones in the devkit's orientation.

    Attributes:
        grid: the cells, right-handed metres. Its orientation is `orientation`.
        receptive_field: frames up to the present that a model sees, the present included.
        future_frames: frames after the present that labels show.
        step: recorded frames (0.1 s) from one label frame to the next; 5 is 2 Hz.
        only_vehicle: leave out pedestrians (two-wheelers are vehicles, as in all three codes).
        filter_invisible: draw only what the cooperating agents see by the released rule (evaluation.md f).
        agents: whose sight counts; None for all that are there, whoever cooperates: the released way.
        draw_ego: draw the ego's own box (the roadside pole has none).
        ignore_index: what stands in offset and flow beside instances, and in missing frames where they are ignored.
        orientation: how the cells lie in arrays; None for the grid's own.
        sigma: radius of the centres' peaks, cells: exp(−d² / σ²), as FIERY.
        protocol: `released`, `clean`, `beverse`, `fiery`, or a `LabelProtocol` of your own.
        augmentation: a rotation, scale and flip in each frame's ego frame; None for none.
    """

    grid: BevGrid = field(default_factory=BevGrid)
    receptive_field: int = 3
    future_frames: int = 4
    step: int = 5
    only_vehicle: bool = False
    filter_invisible: bool = True
    agents: Agents = None
    draw_ego: bool = True
    ignore_index: int = 255
    orientation: Orientation | None = None
    sigma: float = 3.0
    protocol: str | LabelProtocol = "released"
    augmentation: Augmentation | None = None

    def __post_init__(self) -> None:
        """Check and complete; raises ConfigError or ChoiceError, each with the remedy."""
        _check_count("receptive_field", self.receptive_field, "the present frame itself counts")
        _check_count("future_frames", self.future_frames, "labels of motion need at least one frame to come")
        _check_count("step", self.step, "recorded frames between label frames, 5 for 2 Hz")
        _check_count("ignore_index", self.ignore_index, "a mark beside the maps' values, such as 255")
        if self.ignore_index > _BYTE:
            raise ConfigError(
                f"ignore_index: {self.ignore_index} does not fit the maps; choose 1 to {_BYTE}, such as 255"
            )
        if not 0 < self.sigma < float("inf"):
            raise ConfigError(f"sigma: {self.sigma!r} is no radius; choose a number of cells above 0, such as 3")
        label_protocol(self.protocol)
        orientation = self.grid.orientation if self.orientation is None else self.orientation
        object.__setattr__(self, "grid", self.grid.with_orientation(orientation))
        object.__setattr__(self, "orientation", orientation)

    @classmethod
    def preset(cls, name: str, **changes: Any) -> MotionLabelConfig:
        """A preset of `PRESETS`, with some fields changed.

        Raises:
            ChoiceError: no such preset.
            ConfigError: no such field, or a value that cannot be.
        """
        if name not in PRESETS:
            raise ChoiceError(f"preset: expected one of {', '.join(PRESETS)}, found {name!r}")
        unknown = sorted(set(changes) - set(cls.__dataclass_fields__))
        if unknown:
            raise ConfigError(
                f"preset: there is no field {unknown[0]!r}; there are {', '.join(cls.__dataclass_fields__)}"
            )
        return replace(PRESETS[name], **changes)

    @property
    def rules(self) -> LabelProtocol:
        """The protocol's switches."""
        return label_protocol(self.protocol)

    @property
    def label_frames(self) -> int:
        """Frames that labels show: the present and the future ones."""
        return 1 + self.future_frames

    @property
    def frames(self) -> int:
        """Frames from the first past to the last future one: the rows of `future_egomotion`."""
        return self.receptive_field + self.future_frames

    @property
    def offsets(self) -> range:
        """Recorded frames from the present to each of `frames`, the past negative."""
        return range(-(self.receptive_field - 1) * self.step, self.future_frames * self.step + 1, self.step)

    def as_dict(self) -> dict[str, Any]:
        """All that decides the labels' values, as JSON can hold it; protocols as their switches."""
        described = asdict(replace(self, agents=None, protocol=self.rules))
        described["grid"] = {"x": list(self.grid.x), "y": list(self.grid.y)}
        described["agents"] = _agents_text(self.agents)
        return described

    @classmethod
    def from_dict(cls, described: Mapping[str, Any]) -> MotionLabelConfig:
        """The configuration that `as_dict` describes.

        Raises:
            ConfigError: it describes none.
            ChoiceError: a choice in it does not exist.
        """
        try:
            values = dict(described)
            grid = values.pop("grid")
            protocol = LabelProtocol(**values.pop("protocol"))
            named = next((name for name, rules in LABEL_PROTOCOLS.items() if rules == protocol), None)
            augmentation, agents = values.pop("augmentation"), values.pop("agents")
            return cls(
                grid=BevGrid(tuple(grid["x"]), tuple(grid["y"])),
                protocol=named or protocol,
                augmentation=None if augmentation is None else Augmentation(**augmentation),
                agents=AgentConfig(agents["name"], tuple(agents["partners"])) if isinstance(agents, dict) else agents,
                **values,
            )
        except (KeyError, TypeError, AttributeError) as error:
            raise ConfigError(f"label configuration: cannot be read ({error})") from error

    @property
    def digest(self) -> str:
        """A short hash of `as_dict`: equal exactly for configurations that give the same labels."""
        return hashlib.sha256(json.dumps(self.as_dict(), sort_keys=True).encode()).hexdigest()[:16]


def _agents_text(agents: Agents) -> Any:
    if agents is None or isinstance(agents, str):
        return agents
    if isinstance(agents, Sequence):
        return list(agents)
    return {"name": agents.name, "partners": list(agents.partners)}


def _check_count(name: str, value: object, why: str) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise ConfigError(f"{name}: expected a whole number from 1, found {value!r}; {why}")


_DEEPACCIDENT: Final = MotionLabelConfig()
_BEVERSE: Final = MotionLabelConfig(only_vehicle=True, draw_ego=False, protocol="beverse")
PRESETS: Final[Mapping[str, MotionLabelConfig]] = {
    "deepaccident": _DEEPACCIDENT,
    **{
        f"deepaccident-{seconds}s": replace(_DEEPACCIDENT, future_frames=seconds * _STEPS_PER_SECOND)
        for seconds in (3, 4, 5)
    },
    "beverse": _BEVERSE,
    "fiery": replace(_BEVERSE, protocol="fiery", orientation="fiery"),
}
"""The released labels (2 s ahead), the same 3, 4 and 5 s ahead, and those of the two codes it comes from."""
