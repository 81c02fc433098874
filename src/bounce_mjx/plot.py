"""Draws learning curves and an evaluation: `python -m bounce_mjx.plot [RUN ...]`."""

import sys

from bounce_mjx.commands.main import main

if __name__ == "__main__":
    main(["plot", *sys.argv[1:]])
