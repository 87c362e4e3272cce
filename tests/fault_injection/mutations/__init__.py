"""All mutations, by name."""

from collections.abc import Mapping

import numpy as np

from fault_injection.kinds import Mutation
from fault_injection.mutations import (
    calib,
    cameras,
    frames,
    label_form,
    label_geometry,
    label_rows,
    meta,
    release,
    sensors,
)

_GROUPS = (
    label_form.GROUP,
    label_rows.GROUP,
    label_geometry.GROUP,
    calib.GROUP,
    calib.POSES,
    cameras.GROUP,
    meta.GROUP,
    frames.GROUP,
    sensors.IMAGES,
    sensors.LIDARS,
    sensors.BEVS,
    release.GROUP,
)
MUTATIONS: Mapping[str, Mutation] = {
    mutation.name: mutation for group in _GROUPS for mutation in group.mutations
}
"""Name → mutation, in the table's order."""
HARMLESS: Mapping[str, str] = {
    name: mutation.harmless for name, mutation in MUTATIONS.items() if mutation.harmless is not None
}
"""Names of the mutations that `validate` may let pass, as they do no harm → why."""
BEYOND: Mapping[str, str] = {
    name: mutation.beyond for name, mutation in MUTATIONS.items() if mutation.beyond is not None
}
"""Names of the faults that `validate` does not tell → why."""


def seeded(name: str, seed: int) -> np.random.Generator:
    """The source of all that is random in one application."""
    return np.random.default_rng([seed, *name.encode()])


__all__ = ["BEYOND", "HARMLESS", "MUTATIONS", "Mutation", "seeded"]
