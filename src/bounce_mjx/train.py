"""Trains a policy: `python -m bounce_mjx.train`."""

import sys

from bounce_mjx.commands.main import main

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])
