"""Shows a trained policy: `python -m bounce_mjx.play [CHECKPOINT]`."""

from bounce_mjx.commands.play import main

if __name__ == "__main__":
    main()
