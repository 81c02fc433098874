"""Finds the start pose and the servos of an arm: `python -m bounce_mjx.adopt MJCF`."""

import sys

from bounce_mjx.commands.main import main

if __name__ == "__main__":
    main(["adopt", *sys.argv[1:]])
