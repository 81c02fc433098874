"""Exports a trained policy for robots and other programs: `bounce-mjx export [CHECKPOINT]`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from bounce_mjx.commands.which_policy import WhichPolicy
from bounce_mjx.config.command_line import Flag, parse


# Without the mirror law, which has no network: not `OnePolicy`, and not `choose`.
class ExportCommand(WhichPolicy):
    """Exports a trained policy, with the environment of its training, as an ONNX file."""

    checkpoint: Annotated[Path | None, Flag(metavar="[CHECKPOINT]", is_positional=True)] = None
    """A run's folder (its best checkpoint), a checkpoint in it, latest for the newest run, or a
    policy that comes with the package: pretrained, robust, robust_small, or the name of a task or
    an arm. The default is the newest run, or the task's policy in the package if there is no
    run."""
    onnx: Annotated[Path, Flag(instead_of=("--out",))] = Path("policy.onnx")
    """ONNX file to write: normaliser, network and clipping in one graph, and metadata."""


def main(args: Sequence[str]) -> None:
    """Runs the command line."""
    command = parse(ExportCommand, args, prog="bounce-mjx export")
    from bounce_mjx.deploy.export import export_onnx
    from bounce_mjx.runs.folders import choose_checkpoint
    from bounce_mjx.runs.storage import check_output, write_output
    from bounce_mjx.training.setup import set_up_jax

    check_output(command.onnx, "--onnx")
    folder = command.folder_for(command.checkpoint)
    set_up_jax()
    checkpoint = choose_checkpoint(command.checkpoint, folder)
    print(f"checkpoint: {checkpoint.folder} ({checkpoint.steps:,} steps)")
    content = export_onnx(checkpoint)
    write_output(command.onnx, content)
    print(f"written: {command.onnx} ({len(content) / 1000:.0f} kB)")
