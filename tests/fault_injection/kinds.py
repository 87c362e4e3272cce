"""What a mutation is, and the ways to damage a file, a matrix or an actor."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from deepaccident_devkit.taxonomy import CAMERAS
from fault_injection.editor import FrameChoice, UndoableEditor

Apply = Callable[[UndoableEditor, np.random.Generator], object]
"""Damages a scenario."""
DamageActor = Callable[[UndoableEditor, np.random.Generator, str, Sequence[int], int], object]
"""Damages an actor's boxes in an agent's labels of some frames."""
MatrixEdit = Callable[[np.ndarray], np.ndarray]
Only = Literal["accident", "normal"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Mutation:
    """One way to damage a release.

    Attributes:
        name: Name in the table.
        group: Kind of file that it damages.
        title: What it does, in a phrase.
        apply: Function that damages a scenario.
        deep: Whether only the sensors' files show it.
        harmless: Why it cannot be found, or need not be; None for a fault.
        beyond: Why `validate` need not find this fault; None if it must.
        only: Kind of scenario that it can damage; None for both.
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
    """Collects the mutations of one module."""

    name: str
    deep: bool = False
    mutations: list[Mutation] = field(default_factory=list)

    def add(self, rows: Mapping[str, tuple[str, Apply]], **fields: Any) -> None:
        """Add a mutation for each row: name → description and function.

        All have the same further fields.
        """
        fields = {"deep": self.deep, **fields}
        for name, (description, apply) in rows.items():
            title = " ".join(description.split()).rstrip(".")
            self.mutations.append(
                Mutation(name=name, group=self.name, title=title, apply=apply, **fields)
            )


def edit_file(kind: str, change: Callable[[bytes, np.random.Generator], bytes]) -> Apply:
    """Change the bytes of one file of a kind (`FILE_ENDINGS`, or `Camera` for any camera)."""

    def apply(editor: UndoableEditor, rng: np.random.Generator) -> None:
        chosen_kind = str(rng.choice(CAMERAS)) if kind == "Camera" else kind
        path = editor.file(editor.any_agent(rng), chosen_kind, editor.any_frame(rng))
        editor.write(path, change(path.read_bytes(), rng))

    return apply


def edit_matrix(
    key: str,
    edit: MatrixEdit | None = None,
    *,
    draw_edit: Callable[[np.random.Generator], MatrixEdit] | None = None,
    always: bool,
) -> Apply:
    """Edit a matrix of an agent's calib files at one frame, or `always`.

    The edit is `edit`, or the one that `draw_edit` draws. In the key, `{}` stands for any camera.
    """

    def apply(editor: UndoableEditor, rng: np.random.Generator) -> None:
        agent = editor.any_agent(rng)
        frames = editor.frames if always else [editor.any_frame(rng)]
        chosen_key = key.format(rng.choice(CAMERAS)) if "{}" in key else key
        editor.edit_calib(agent, frames, chosen_key, edit or draw_edit(rng))

    return apply


def damage_actor(
    damage: DamageActor, choose_frames: FrameChoice, *, lone: bool = False, **criteria: Any
) -> Apply:
    """Damage an actor in one agent's labels.

    Other agents see the actor too, or, with `lone`, no other agent is there.
    """

    def apply(editor: UndoableEditor, rng: np.random.Generator) -> None:
        choose_actor = editor.lone_actor if lone else editor.shared_actor
        agent, actor = choose_actor(rng, **criteria)
        damage(editor, rng, agent, choose_frames(editor, rng), actor)

    return apply


def cut(content: bytes, rng: np.random.Generator, *, end: int | None = None) -> bytes:
    """Keep the beginning of a file: at least one byte, and not the last two."""
    length = end or len(content)
    return content[: rng.integers(1, length - 1)]


def empty(*_: object) -> bytes:
    return b""


def garbage(content: bytes, rng: np.random.Generator) -> bytes:
    """Return as many random bytes as the content has, but at least sixteen."""
    length = max(len(content), 16)
    return rng.integers(0, 256, size=length, dtype=np.uint8).tobytes()
