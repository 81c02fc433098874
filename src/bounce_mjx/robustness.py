"""Measures the five results in perturbed worlds: `python -m bounce_mjx.robustness [CHECKPOINT]`."""

import sys

from bounce_mjx.commands.main import main

if __name__ == "__main__":
    main(["robustness", *sys.argv[1:]])
