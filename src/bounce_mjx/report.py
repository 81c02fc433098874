"""Writes the report of a run: `python -m bounce_mjx.report [RUN]`."""

import sys

from bounce_mjx.commands.main import main

if __name__ == "__main__":
    main(["report", *sys.argv[1:]])
