"""The console script as a module: `python -m bounce_mjx COMMAND`."""

from bounce_mjx.commands.main import main

if __name__ == "__main__":
    main()
