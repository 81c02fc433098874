"""Shows a trained policy: `python -m bounce_mjx.play [CHECKPOINT]`."""

import sys

from bounce_mjx.commands.main import main

if __name__ == "__main__":
    main(["play", *sys.argv[1:]])
