"""Measures the five results of a trained policy: `python -m bounce_mjx.eval [CHECKPOINT]`."""

import sys

from bounce_mjx.commands.main import main

if __name__ == "__main__":
    main(["eval", *sys.argv[1:]])
