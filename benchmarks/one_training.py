"""One training of `jax_vs_torch.py`. Ours starts what its command starts before its imports."""

import sys

from bounce_mjx.training.command import early_flag
from bounce_mjx.training.helpers import start_helpers

helpers = start_helpers(sys.argv) if early_flag(sys.argv, "--methods") == "ours" else None

from bounce_mjx.training.setup import find_devices, set_up_gpu  # noqa: E402

set_up_gpu()
if helpers is not None:
    find_devices()

import jax_vs_torch  # noqa: E402

from bounce_mjx.errors import exit_on_user_error  # noqa: E402

with exit_on_user_error():
    jax_vs_torch.train_here(jax_vs_torch.read_command(sys.argv[1:]), helpers)
