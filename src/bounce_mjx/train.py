"""Trains a policy: `python -m bounce_mjx.train`."""

from bounce_mjx.commands.train import main

if __name__ == "__main__":
    main()
