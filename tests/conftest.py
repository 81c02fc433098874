"""Tests of optional packages are skipped where a package is missing; CI must have all of them."""

import importlib.util
import os

import pytest

from bounce_mjx.errors import UserError
from bounce_mjx.viewers.offscreen import choose_backend

OPTIONAL = "CI" not in os.environ
HAS_TORCH = all(importlib.util.find_spec(name) for name in ("torch", "rsl_rl", "skrl"))

collect_ignore = ["test_torch.py", "test_torch_train.py"] if OPTIONAL and not HAS_TORCH else []


def pytest_report_header() -> list[str]:
    return [f"skipped, as PyTorch is missing: {name}" for name in collect_ignore]


@pytest.fixture(scope="session")
def torch_libraries() -> None:
    """PyTorch and its trainers."""
    if OPTIONAL and not HAS_TORCH:
        pytest.skip("PyTorch is missing; pip install -e '.[torch]'")


@pytest.fixture(scope="session")
def opengl() -> None:
    """A library that can draw without a screen."""
    try:
        choose_backend()
    except UserError as error:
        if OPTIONAL:
            pytest.skip(str(error))
        raise
