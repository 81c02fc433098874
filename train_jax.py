"""Trains a policy: `python train_jax.py --num-envs 4096` (see --help)."""

import sys


def refuse(reason: str) -> None:
    """Ends the process with one sentence."""
    print(f"error: {reason}; or use: uv run train_jax.py", file=sys.stderr)
    sys.exit(2)


if sys.version_info < (3, 11):  # noqa: UP036
    refuse("Python {}.{} is too old; use 3.11 to 3.13".format(*sys.version_info))
try:
    from bounce_mjx.commands.main import main
except ModuleNotFoundError as error:
    if error.name != "bounce_mjx":
        raise
    folder = __file__.rpartition("/")[0] or "."
    refuse(f"bounce_mjx is not installed for {sys.executable}; run: pip install -e {folder}")

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])
