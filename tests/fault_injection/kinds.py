"""What a mutation is."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from deepaccident_devkit.taxonomy import CAMERAS
from fault_injection.place import Frames, Place

Apply = Callable[[Place, np.random.Generator], None]
Matrix = Callable[[np.ndarray], np.ndarray]
Only = Literal["accident", "normal"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Mutation:
    """One way to damage a release.

    Attributes:
        name: its name in the table.
        group: what kind of file it damages.
        title: what it does, in a phrase.
        apply: damages a scenario.
        deep: whether only the sensors' files show it.
        harmless: why it cannot be found, or need not be; None for a fault.
        beyond: why `validate` need not find this fault; None if it must.
        only: the kind of scenario that it can damage; None for both.
    """

    name: str
    group: str
    title: str
    apply: Apply
    deep: bool = False
    harmless: str | None = None
    beyond: str | None = None
    only: Only | None = None


@dataclass(slots=True)
class Group:
    """Gathers the mutations of one module."""

    name: str
    deep: bool = False
    mutations: list[Mutation] = field(default_factory=list)

    def add(self, rows: Mapping[str, tuple[str, Apply]], **how: Any) -> None:
        """Enter a mutation a row: name → what it does, and the function; all have the same further
        fields.
        """
        for name, (says, apply) in rows.items():
            title = " ".join(says.split()).rstrip(".")
            self.mutations.append(
                Mutation(
                    name=name,
                    group=self.name,
                    title=title,
                    apply=apply,
                    **{"deep": self.deep, **how},
                )
            )


def in_file(kind: str, change: Callable[[bytes, np.random.Generator], bytes]) -> Apply:
    """Change the bytes of a file of a kind (`ENDINGS`, or `Camera` for any of them) at a frame of
    an agent.
    """

    def apply(place: Place, rng: np.random.Generator) -> None:
        drawn = str(rng.choice(CAMERAS)) if kind == "Camera" else kind
        path = place.file(place.any_agent(rng), drawn, place.any_frame(rng))
        place.write(path, change(path.read_bytes(), rng))

    return apply


def in_calib(
    key: str,
    edit: Matrix | None = None,
    *,
    drawn: Callable[[np.random.Generator], Matrix] | None = None,
    always: bool,
) -> Apply:
    """Edit a matrix of an agent's calib at a frame or always: as it is said or `drawn`; `{}` stands
    for a camera.
    """

    def apply(place: Place, rng: np.random.Generator) -> None:
        agent, frames = place.any_agent(rng), place.frames if always else [place.any_frame(rng)]
        place.edit_calib(
            agent,
            frames,
            key.format(rng.choice(CAMERAS)) if "{}" in key else key,
            edit or drawn(rng),
        )

    return apply


def of_actor(
    damage: Callable[[Place, np.random.Generator, str, Sequence[int], int], object],
    when: Frames,
    *,
    lone: bool = False,
    **which: Any,
) -> Apply:
    """Damage what an agent says of an actor that others see too, or `lone` of one that nobody else
    sees.
    """

    def apply(place: Place, rng: np.random.Generator) -> None:
        agent, actor = (place.lone_actor if lone else place.shared_actor)(rng, **which)
        damage(place, rng, agent, when(place, rng), actor)

    return apply


def cut(content: bytes, rng: np.random.Generator, *, end: int | None = None) -> bytes:
    """The beginning of a file: at least a byte stays and two go."""
    return content[: rng.integers(1, (end or len(content)) - 1)]


def emptied(*_: object) -> bytes:
    """Nothing."""
    return b""


def garbage(content: bytes, rng: np.random.Generator) -> bytes:
    """As many random bytes, sixteen at least."""
    return rng.integers(0, 256, size=max(len(content), 16), dtype=np.uint8).tobytes()
