"""What a breakage is, and how it changes a release."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from deepaccident_devkit.errors import ReleaseError
from deepaccident_devkit.taxonomy import INFRASTRUCTURE, AgentName
from deepaccident_devkit.testing.editing import ScenarioEditor

Apply = Callable[["Victim"], Path]


@dataclass(frozen=True, slots=True, kw_only=True)
class Breakage:
    """One named way in which a release can be broken, or odd though its format allows it.

    Attributes:
        name: such as `label-cut`.
        group: what is broken: `label`, `calib`, `meta`, `sensor`, `release`; `legal` for what a loader must take.
        description: one sentence.
        codes: what `deepaccident validate` says of a small release that is broken so, and not of a healthy one,
            sorted; none where there is nothing to say.
        deep: whether it needs `--deep` for that.
        opening: the error of `DeepAccident(...)`; None if the release can be opened.
        reading: the error of the reader of the broken file; None if there is no such file, or it can be read.
        channel: the sensor whose files it needs, None for those that need labels, calib and meta alone.
        apply: breaks it; returns the file or folder that is broken.
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
class BrokenRelease:
    """A release after it was broken.

    Attributes:
        root: its folder.
        breakage: how it is broken.
        scenario: token of the scenario that is broken; the others are as they were.
        agent: the agent whose files are broken, where it is one's.
        frame: the frame whose files are broken, where it is one's.
        path: the file or folder that is broken, missing or odd.
        marker: a folder that a program hidden in the release makes if somebody runs it; must never be there.
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
        frame: one amid the scenario.
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
    """Gathers the breakages of one module, each a function named as the breakage, with its description as docstring."""

    name: str
    opening: type[ReleaseError] | None = None
    reading: type[ReleaseError] | None = None
    deep: bool = False
    breakages: list[Breakage] = field(default_factory=list)

    def enter(self, *codes: str, channel: str | None = None) -> Callable[[Apply], Apply]:
        """Enter the decorated function, with what `validate` says and the sensor whose files it needs."""

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
