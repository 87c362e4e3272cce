"""V2XFormer, the model that was published with DeepAccident, in plain PyTorch (the extra `torch`).

    from deepaccident_devkit import DeepAccident
    from deepaccident_devkit.plugins.model import ModelChoice, PredictConfig
    from deepaccident_devkit.plugins.model import load_model, predict_results, train

    da = DeepAccident(dataroot="data/DeepAccident")
    train(da, "runs/all", ModelChoice(preset="tiny"))
    tokens = da.evaluation_samples("val")
    predict_results(load_model("runs/all"), da, tokens, "results", PredictConfig(agents="all"))

The preset `released` reproduces the released modules, with their quirks as fields of its
configuration. `tiny` can be trained on a laptop (docs/training.md), and its weights come with the
devkit (docs/model.md). `network` lists the modules from images to predictions. Importing a name
from it without torch raises MissingExtraError.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from deepaccident_devkit.errors import MissingExtraError

if TYPE_CHECKING:
    from deepaccident_devkit.plugins.model.checkpoint import (
        Loaded,
        Weights,
        load_weights,
        read_weights,
        write_weights,
    )
    from deepaccident_devkit.plugins.model.inputs import ModelInputs, model_inputs
    from deepaccident_devkit.plugins.model.network import ModelConfig, ModelPredictions, V2XFormer
    from deepaccident_devkit.plugins.model.presets import MODEL_PRESETS, ModelChoice, load_model
    from deepaccident_devkit.plugins.model.results import (
        PredictConfig,
        SamplePrediction,
        predict_results,
        predictions,
        scores_text,
    )
    from deepaccident_devkit.plugins.model.training_loop import train
    from deepaccident_devkit.plugins.model.training_run import (
        SecondSource,
        TrainConfig,
        checked_device,
    )

# Public name → its module.
_MODULES = {
    **dict.fromkeys(
        ("Loaded", "Weights", "load_weights", "read_weights", "write_weights"), "checkpoint"
    ),
    **dict.fromkeys(("ModelInputs", "model_inputs"), "inputs"),
    **dict.fromkeys(("ModelConfig", "ModelPredictions", "V2XFormer"), "network"),
    **dict.fromkeys(("MODEL_PRESETS", "ModelChoice", "load_model"), "presets"),
    **dict.fromkeys(
        ("PredictConfig", "SamplePrediction", "predict_results", "predictions", "scores_text"),
        "results",
    ),
    **dict.fromkeys(("SecondSource", "TrainConfig", "checked_device"), "training_run"),
    "train": "training_loop",
}

__all__ = [
    "MODEL_PRESETS",
    "Loaded",
    "ModelChoice",
    "ModelConfig",
    "ModelInputs",
    "ModelPredictions",
    "PredictConfig",
    "SamplePrediction",
    "SecondSource",
    "TrainConfig",
    "V2XFormer",
    "Weights",
    "checked_device",
    "load_model",
    "load_weights",
    "model_inputs",
    "predict_results",
    "predictions",
    "read_weights",
    "scores_text",
    "train",
    "write_weights",
]


def __getattr__(name: str) -> Any:
    """Import a public name's module when the name is first used.

    Thanks to this, the help of the command `train` works without torch.
    """
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        import safetensors  # noqa: F401 - as torch
        import torch  # noqa: F401 - nothing here works without it
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            f"the model needs PyTorch and safetensors, and {error.name} is not installed; run pip "
            "install '.[torch]' in a checkout (for PyTorch's CPU build, first pip install torch "
            "--index-url https://download.pytorch.org/whl/cpu)"
        ) from error
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
