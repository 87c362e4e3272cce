"""The mutations themselves: each changes something, the same with the same seed, and is undone."""

from pathlib import Path

import pytest

from fault_injection.mutations import MUTATIONS
from fault_injection.place import Place
from fault_injection.run import Job, mutate, places

pytestmark = pytest.mark.slow

SEED = 1


@pytest.fixture(scope="module")
def own_places(healthy_release: Path, release_copy: Path) -> dict[str, Place]:
    return places(release_copy)


def applied(name: str, of: dict[str, Place]) -> tuple[str, dict[str, bytes | None]]:
    """The scenario that a mutation damages, and the changed files, which are put back."""
    place = mutate(Job(name, SEED), of)
    changes = place.changes()
    place.restore()
    return place.token, changes


@pytest.mark.parametrize("name", MUTATIONS)
def test_a_mutation_changes_files_and_depends_on_its_seed_alone(own_places, name):
    token, changes = applied(name, own_places)
    assert changes
    assert applied(name, own_places) == (token, changes)


def test_restoring_brings_every_file_back(own_places, healthy_release):
    for name in MUTATIONS:
        applied(name, own_places)
    assert contents(next(iter(own_places.values())).root) == contents(healthy_release)


def test_every_mutation_says_what_it_does():
    assert len({mutation.title for mutation in MUTATIONS.values()} - {""}) == len(MUTATIONS)


def contents(root: Path) -> dict[str, bytes]:
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file() and ".deepaccident" not in path.parts
    }
