"""Trains with PyTorch: `python train_torch.py --library rsl_rl` (see --help)."""

import sys

from bounce_mjx.commands.main import main

if __name__ == "__main__":
    main(["train-torch", *sys.argv[1:]])
