"""The environment for PyTorch, without a copy through DLPack; needs the extra `torch`."""

try:
    import torch  # noqa: F401
except ImportError as error:
    raise ImportError(
        "bounce_mjx.adapters.torch needs PyTorch, which is not installed; "
        "install it with pip install 'bounce_mjx[torch]'"
    ) from error

from bounce_mjx.adapters.torch.vector_env import StepResult, TorchVectorEnv

__all__ = ["StepResult", "TorchVectorEnv"]
