"""One training run of `jax_vs_torch.py`, which sets JAX up before it imports the libraries."""

import sys

import jax

from bounce_mjx.interrupt import in_daemon_thread
from bounce_mjx.training.setup import set_up_gpu

set_up_gpu()
if sys.argv[sys.argv.index("--methods") + 1] == "ours":
    in_daemon_thread(jax.devices)

import jax_vs_torch  # noqa: E402

from bounce_mjx.errors import exit_on_user_error  # noqa: E402

with exit_on_user_error():
    jax_vs_torch.train_here(jax_vs_torch.read_command(sys.argv[1:]))
