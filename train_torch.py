"""Trains with PyTorch: `python train_torch.py --library rsl_rl` (see --help)."""

from bounce_mjx.commands.train_torch import main

if __name__ == "__main__":
    main()
