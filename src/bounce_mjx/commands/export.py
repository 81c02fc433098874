"""Exports a trained policy for robots and other programs: `bounce-mjx export [CHECKPOINT]`."""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from bounce_mjx.commands.run_options import PolicyCommand
from bounce_mjx.config.command_line import parse
from bounce_mjx.errors import UserError, exit_on_user_error


class ExportCommand(PolicyCommand):
    """Exports a trained policy as an ONNX file or a JAX function."""

    onnx: Path | None = None
    """ONNX file to write: normaliser, network and clipping in one graph, and metadata."""
    jax: Path | None = None
    """File for the network alone by jax.export, for the CPU and CUDA: histories in, actions out."""


@exit_on_user_error()
def main(args: Sequence[str]) -> None:
    """Runs the command line."""
    command = parse(ExportCommand, args, prog="bounce-mjx export")
    if command.onnx is None and command.jax is None:
        raise UserError("there is no file to write; give --onnx FILE or --jax FILE")
    from bounce_mjx.deploy.export import export_jax, export_onnx
    from bounce_mjx.runs.files import check_output, writable, write_output
    from bounce_mjx.runs.folders import choose_checkpoint
    from bounce_mjx.training.setup import set_up_jax

    files = {"--onnx": (command.onnx, export_onnx), "--jax": (command.jax, export_jax)}
    for flag, (path, _) in files.items():
        check_output(path, flag)
    set_up_jax()
    console = Console()
    checkpoint = choose_checkpoint(command.checkpoint, command.folder, console)
    console.out(f"checkpoint: {checkpoint.folder} ({checkpoint.steps:,} steps)", highlight=False)
    command.config(checkpoint.run)
    for flag, (path, export) in files.items():
        if path is None:
            continue
        content = export(checkpoint)
        with writable(path, f"give another file with {flag}"):
            write_output(path, content)
        console.out(f"written: {path} ({len(content) / 1000:.0f} kB)", highlight=False)
