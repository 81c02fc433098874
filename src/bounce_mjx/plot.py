"""Draws learning curves and an evaluation: `python -m bounce_mjx.plot [RUN ...]`."""

from bounce_mjx.commands.plot import main

if __name__ == "__main__":
    main()
