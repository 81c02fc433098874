"""Trains a policy: `python train_jax.py --num-envs 4096` (see --help)."""

import sys

from bounce_mjx.commands.main import main

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])
