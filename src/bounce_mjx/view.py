"""Shows the environment without a policy: `python -m bounce_mjx.view`."""

from bounce_mjx.commands.view import main

if __name__ == "__main__":
    main()
