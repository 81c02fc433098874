"""Measures the five results of a trained policy: `python -m bounce_mjx.eval [CHECKPOINT]`."""

from bounce_mjx.commands.eval import main

if __name__ == "__main__":
    main()
