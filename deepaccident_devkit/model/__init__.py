"""V2XFormer, the model that was published with DeepAccident, in plain PyTorch (the extra `torch`).

    from deepaccident_devkit import DeepAccident
    from deepaccident_devkit.model import ModelChoice, PredictConfig, load_model, predict_results, train

    da = DeepAccident(dataroot="data/DeepAccident")
    train(da, "runs/all", ModelChoice(preset="tiny"))
    tokens = da.evaluation_samples("val")
    predict_results(load_model("runs/all"), da, tokens, "results", PredictConfig(agents="all"))

The preset `released` is equal to the released modules, with their quirks as fields of its configuration; `tiny` is
trained by a laptop (docs/training.md), and its weights come with the devkit (docs/model.md). `network` says which
module does what on the way from images to predictions.
Importing it without torch raises MissingExtraError.
"""

from deepaccident_devkit.errors import MissingExtraError

try:
    import safetensors  # noqa: F401 - as torch
    import torch  # noqa: F401 - nothing here works without it
except ModuleNotFoundError as error:
    raise MissingExtraError(
        "the model needs PyTorch and safetensors: in a checkout, pip install '.[torch]' "
        "(for PyTorch's CPU build alone: pip install torch --index-url https://download.pytorch.org/whl/cpu)"
    ) from error

from deepaccident_devkit.model.checkpoint import Loaded, Weights, load_weights, read_weights, write_weights
from deepaccident_devkit.model.inputs import ModelInputs, model_inputs
from deepaccident_devkit.model.network import ModelConfig, Predictions, V2XFormer
from deepaccident_devkit.model.presets import PRESETS, ModelChoice, load_model
from deepaccident_devkit.model.results import PredictConfig, SamplePrediction, predict_results, predictions
from deepaccident_devkit.model.training_loop import train
from deepaccident_devkit.model.training_run import TrainConfig, checked_device

__all__ = [
    "PRESETS",
    "Loaded",
    "ModelChoice",
    "ModelConfig",
    "ModelInputs",
    "PredictConfig",
    "Predictions",
    "SamplePrediction",
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
    "train",
    "write_weights",
]
