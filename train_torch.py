"""Trains with PyTorch: `python train_torch.py --library rsl_rl` (see --help)."""

import os
import signal

if __name__ == "__main__":
    # Ctrl-C during the imports, in which some library would print a traceback or swallow it.
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    from bounce_mjx.commands.train_torch import main

    signal.signal(signal.SIGINT, signal.default_int_handler)
    main()
