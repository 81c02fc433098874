"""Shows the environment without a policy: `python -m bounce_mjx.view`."""

import sys

from bounce_mjx.commands.main import main

if __name__ == "__main__":
    main(["view", *sys.argv[1:]])
