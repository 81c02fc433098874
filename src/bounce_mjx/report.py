"""Writes the report of a run: `python -m bounce_mjx.report [RUN]`."""

from bounce_mjx.commands.report import main

if __name__ == "__main__":
    main()
