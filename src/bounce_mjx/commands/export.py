"""Exports a trained policy for robots and other programs: `bounce-mjx export [CHECKPOINT]`."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from bounce_mjx.commands.run_options import RunOptions
from bounce_mjx.config.command_line import parse
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.garbage import no_garbage_collection
from bounce_mjx.interrupt import interruptible


class ExportCommand(StrictModel):
    """The command line."""

    checkpoint: Annotated[Path | None, tyro.conf.Positional] = None
    """A run's folder (its best checkpoint), a checkpoint in it, latest for the newest run, or a
    policy that comes with the package: pretrained or robust. The default is the newest run, or
    pretrained if there is no run."""
    onnx: Path | None = None
    """ONNX file to write: normaliser, network and clipping in one graph, and metadata."""
    jax: Path | None = None
    """File for the network alone by jax.export, for the CPU and CUDA: histories in, actions out."""
    of_run: Annotated[RunOptions, tyro.conf.arg(name="")] = RunOptions()


@interruptible
def main(args: Sequence[str] | None = None) -> None:
    """Runs the command line."""
    with exit_on_user_error():
        command = parse(
            ExportCommand,
            sys.argv[1:] if args is None else args,
            prog="bounce-mjx export",
            description="Exports a trained policy as an ONNX file or a JAX function.",
        )
        if command.onnx is None and command.jax is None:
            raise UserError("there is no file to write; give --onnx FILE or --jax FILE")
        with no_garbage_collection():
            from bounce_mjx.deploy.export import export_jax, export_onnx
            from bounce_mjx.runs.files import write_output
            from bounce_mjx.runs.folders import choose_checkpoint
            from bounce_mjx.training.setup import set_up_jax

        files = {"--onnx": (command.onnx, export_onnx), "--jax": (command.jax, export_jax)}
        for flag, (path, _) in files.items():
            if path is not None and not os.path.isdir(path.absolute().parent):
                raise UserError(f"the folder of {flag} {path} does not exist; make it")
            if path is not None and os.path.isdir(path):
                raise UserError(f"{flag} {path} is a folder; give a file")
        set_up_jax()
        console = Console()
        checkpoint = choose_checkpoint(command.checkpoint, command.of_run.folder, console)
        console.out(
            f"checkpoint: {checkpoint.folder} ({checkpoint.steps:,} steps)", highlight=False
        )
        command.of_run.config(checkpoint.run)
        for flag, (path, export) in files.items():
            if path is None:
                continue
            content = export(checkpoint)
            try:
                write_output(path, content)
            except OSError as error:
                raise UserError(
                    f"{flag} {path} cannot be written ({error.strerror}); give another file"
                ) from error
            console.out(f"written: {path} ({len(content) / 1000:.0f} kB)", highlight=False)
