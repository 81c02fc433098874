"""The environment for PyTorch, through DLPack and without a copy; needs the extra `torch`."""

try:
    import torch  # noqa: F401
except ImportError as error:
    raise ImportError(
        "bounce_mjx.torch needs PyTorch, which is not installed; "
        "install it with pip install 'bounce_mjx[torch]'"
    ) from error

from bounce_mjx.adapters.torch.vector_env import StepResult, TorchVectorEnv

__all__ = ["StepResult", "TorchVectorEnv"]
