"""One training of `jax_vs_torch.py`: METHOD SEED, then the flags. It sets JAX up before it imports
the libraries, as for a GPU: unlike `bounce-mjx train`, it does not join the loops of a CPU."""

import sys

import jax

from bounce_mjx.interrupt import in_daemon_thread
from bounce_mjx.training.setup import set_up_gpu

method, seed, *flags = sys.argv[1:]
set_up_gpu()
if method == "ours":
    # As `bounce-mjx train` does; the libraries start JAX's devices when they first use them.
    in_daemon_thread(jax.devices)

import jax_vs_torch  # noqa: E402

from bounce_mjx.errors import exit_on_user_error  # noqa: E402

with exit_on_user_error():
    jax_vs_torch.train_here(jax_vs_torch.read_command(flags), method, int(seed))
