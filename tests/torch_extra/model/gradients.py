"""Gradients of a model's parameters."""

from torch import nn


def names_without_gradient(*modules: nn.Module) -> list[str]:
    """Return the names of parameters without a gradient, or with one of zeros or NaN."""
    return [
        name
        for module in modules
        for name, parameter in module.named_parameters()
        if parameter.grad is None or not parameter.grad.abs().sum() > 0
    ]
