"""Trains a policy: `python train_jax.py --num-envs 4096` (see --help)."""

from bounce_mjx.commands.train import main

if __name__ == "__main__":
    main()
