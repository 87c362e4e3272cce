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


@pytest.mark.parametrize("name", MUTATIONS)
def test_a_mutation_changes_files_and_depends_on_its_seed_alone(own_places, name):
    place, done = mutate(Job(name, SEED), own_places)
    changes = place.changes()
    place.restore()
    assert changes
    assert done
    again, done_again = mutate(Job(name, SEED), own_places)
    changes_again = again.changes()
    again.restore()
    assert (again.token, done_again, changes_again) == (place.token, done, changes)


def test_restoring_brings_every_file_back(own_places, healthy_release):
    for name in MUTATIONS:
        place, _ = mutate(Job(name, 0), own_places)
        place.restore()
    assert contents(next(iter(own_places.values())).root) == contents(healthy_release)


def test_every_mutation_says_what_it_does():
    assert all(mutation.title for mutation in MUTATIONS.values())
    assert len({mutation.title for mutation in MUTATIONS.values()}) == len(MUTATIONS)


def contents(root: Path) -> dict[str, bytes]:
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file() and ".deepaccident" not in path.parts
    }
