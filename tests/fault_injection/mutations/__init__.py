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
"""Name of a mutation that `validate` may let pass, because it does no harm → why."""
BEYOND: Mapping[str, str] = {
    name: mutation.beyond for name, mutation in MUTATIONS.items() if mutation.beyond is not None
}
"""Name of a fault that `validate` need not find → why."""


def seeded(name: str, seed: int) -> np.random.Generator:
    """Return the random generator for one application of a mutation."""
    return np.random.default_rng([seed, *name.encode()])


__all__ = ["BEYOND", "HARMLESS", "MUTATIONS", "Mutation", "seeded"]
