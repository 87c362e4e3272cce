"""Each mutation changes something, the same with the same seed, and can be undone."""

from pathlib import Path

import pytest

from fault_injection.editor import UndoableEditor
from fault_injection.mutations import MUTATIONS
from fault_injection.run import Job, mutate, open_editors

pytestmark = pytest.mark.slow

SEED = 1


@pytest.fixture(scope="module")
def editors(release_copy: Path) -> dict[str, UndoableEditor]:
    return open_editors(release_copy)


def apply_and_undo(
    name: str, editors: dict[str, UndoableEditor]
) -> tuple[str, dict[str, bytes | None]]:
    """Return the token of the scenario that a mutation damages, and the files that it changes."""
    editor = mutate(Job(name, SEED), editors)
    changes = editor.changes()
    editor.restore()
    return editor.token, changes


@pytest.mark.parametrize("name", MUTATIONS)
def test_a_mutation_changes_files_and_depends_only_on_its_seed(editors, name):
    token, changes = apply_and_undo(name, editors)
    assert changes
    assert apply_and_undo(name, editors) == (token, changes)


def test_restoring_brings_every_file_back(editors, healthy_release, release_copy):
    for name in MUTATIONS:
        apply_and_undo(name, editors)
    assert read_files(release_copy) == read_files(healthy_release)


def test_every_mutation_has_its_own_title():
    titles = {mutation.title for mutation in MUTATIONS.values()}
    assert "" not in titles
    assert len(titles) == len(MUTATIONS)


def read_files(root: Path) -> dict[str, bytes]:
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file() and ".deepaccident" not in path.parts
    }
