"""Detection maps without errors."""

import torch

from deepaccident_devkit.plugins.model.detection import TaskMaps, TaskTargets


def perfect_maps(targets: list[TaskTargets]) -> list[TaskMaps]:
    """Make the maps that predict the targets exactly."""
    maps = []
    for target in targets:
        samples, _, rows, columns = target.heatmap.shape
        code = torch.zeros(samples, 10, rows * columns)
        sample, slot = target.mask.nonzero(as_tuple=True)
        code[sample, :, target.cell_index[sample, slot]] = target.box[sample, slot]
        parts = code.view(samples, 10, rows, columns).split([2, 1, 3, 2, 2], dim=1)
        logits = torch.where(target.heatmap == 1, 9.0, -9.0)
        maps.append(TaskMaps(*parts, logits))
    return maps
