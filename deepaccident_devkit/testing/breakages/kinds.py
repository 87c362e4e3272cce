"""What a breakage is, and how it changes a release."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from deepaccident_devkit.errors import ReleaseError
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.taxonomy import INFRASTRUCTURE, AgentName
from deepaccident_devkit.testing.editing import ScenarioEditor

Apply = Callable[["Victim"], Path]


@dataclass(frozen=True, slots=True, kw_only=True)
class Breakage(ShortRepr):
    """One named way in which a release can be broken, or unusual though its format allows it.

    Attributes:
        name: such as `label-cut`.
        group: what is broken: `label`, `calib`, `meta`, `sensor`, `release`; `legal` for what a loader must accept.
        description: one sentence.
        codes: the codes that `deepaccident validate` finds in a small release with this breakage and not in a healthy
            one, sorted; empty if it finds none.
        deep: whether it needs `--deep` to find them.
        opening: the error of `DeepAccident(...)`; None if the release can be opened.
        reading: the error of the reader of the broken file; None if there is no such file, or it can be read.
        channel: the sensor whose files it needs; None if it needs only labels, calib and meta.
        apply: breaks a scenario; returns the broken file or folder.
    """

    name: str
    group: str
    description: str
    codes: tuple[str, ...]
    deep: bool
    opening: type[ReleaseError] | None
    reading: type[ReleaseError] | None
    channel: str | None
    apply: Apply = field(repr=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class BrokenRelease(ShortRepr):
    """A release after it was broken.

    Attributes:
        root: its folder.
        breakage: how it is broken.
        scenario: token of the broken scenario; the others are unchanged.
        agent: the agent whose files are broken, if only one agent's are.
        frame: the frame whose files are broken, if only one frame's are.
        path: the file or folder that is broken, missing or unusual.
        marker: a folder that a program hidden in the release makes if somebody runs it; it must never exist.
    """

    root: Path
    breakage: Breakage
    scenario: str
    agent: AgentName
    frame: int
    path: Path
    marker: Path


@dataclass(frozen=True, slots=True, kw_only=True)
class Victim:
    """The scenario that a breakage breaks.

    Attributes:
        editor: the scenario.
        agent: a vehicle.
        frame: a frame in the middle of the scenario.
        marker: see `BrokenRelease`.
    """

    editor: ScenarioEditor
    agent: AgentName
    frame: int
    marker: Path

    @property
    def other(self) -> AgentName:
        """Another vehicle. Raises LookupError if there is none."""
        others = [agent for agent in self.editor.agents if agent not in (self.agent, INFRASTRUCTURE)]
        if not others:
            raise LookupError("a second vehicle that records")
        return others[0]

    def file(self, kind: str) -> Path:
        """The agent's file of a kind at the frame."""
        return self.editor.file(self.agent, kind, self.frame)

    def replace(self, kind: str, change: Callable[[bytes], bytes]) -> Path:
        """Change the bytes of the agent's file at the frame; returns its path."""
        path = self.file(kind)
        self.editor.write(path, change(path.read_bytes()))
        return path


@dataclass(slots=True)
class Group:
    """Collects the breakages of a module: a function's name is that of the breakage, its docstring the description."""

    name: str
    opening: type[ReleaseError] | None = None
    reading: type[ReleaseError] | None = None
    deep: bool = False
    breakages: list[Breakage] = field(default_factory=list)

    def enter(self, *codes: str, channel: str | None = None) -> Callable[[Apply], Apply]:
        """Add the decorated function, with the codes that `validate` finds and the sensor whose files it needs."""

        def entered(apply: Apply) -> Apply:
            self.breakages.append(
                Breakage(
                    name=apply.__name__.replace("_", "-"),
                    group=self.name,
                    description=" ".join((apply.__doc__ or "").split()),
                    codes=tuple(sorted(codes)),
                    deep=self.deep,
                    opening=self.opening,
                    reading=self.reading,
                    channel=channel,
                    apply=apply,
                )
            )
            return apply

        return entered
