"""V2XFormer, the model that was published with DeepAccident, in plain PyTorch (the extra `torch`).

Importing it without torch raises MissingExtraError.
"""

from deepaccident_devkit.errors import MissingExtraError

try:
    import torch  # noqa: F401 - nothing here works without it
except ModuleNotFoundError as error:
    raise MissingExtraError(
        "the model needs PyTorch: in a checkout, pip install '.[torch]' "
        "(for its CPU build alone: pip install torch --index-url https://download.pytorch.org/whl/cpu)"
    ) from error
