"""The environment for PyTorch, through DLPack, without a copy; needs the extra `torch`."""

from bounce_mjx.errors import needed

with needed("PyTorch", "bounce_mjx[torch]"):
    import torch  # noqa: F401

from bounce_mjx.adapters.torch.vector_env import StepResult, TorchVectorEnv

__all__ = ["StepResult", "TorchVectorEnv"]
