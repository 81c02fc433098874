"""Exports a trained policy: `python -m bounce_mjx.export [CHECKPOINT] --onnx FILE`."""

import sys

from bounce_mjx.commands.main import main

if __name__ == "__main__":
    main(["export", *sys.argv[1:]])
