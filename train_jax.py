"""Trains a policy: `python train_jax.py --num-envs 4096` (see --help)."""

import os
import signal

if __name__ == "__main__":
    # Ctrl-C during the imports, in which some library would print a traceback or swallow it.
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    from bounce_mjx.commands.train import main

    signal.signal(signal.SIGINT, signal.default_int_handler)
    main()
