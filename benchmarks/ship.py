"""Makes the policy that comes with the package from a run, for maintainers:
`python benchmarks/ship.py RUN`."""

import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import jax
import tyro
from rich.console import Console

from bounce_mjx.config.command_line import parse
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.deploy.export import export_onnx
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.evaluation.config import DEFAULT_SEED, EvaluationOptions
from bounce_mjx.evaluation.policy_evaluation import evaluate_policy
from bounce_mjx.interrupt import run_interruptible
from bounce_mjx.learning.policy import networks_of
from bounce_mjx.reports.tables import details_line, results_table
from bounce_mjx.resources import POLICIES, PRETRAINED
from bounce_mjx.runs.config import CONFIG_FILE, load_run_config, runs_folder
from bounce_mjx.runs.folders import (
    best_checkpoint,
    find_checkpoint,
    save_config,
)
from bounce_mjx.runs.progress import load_results
from bounce_mjx.runs.reading import read_policy
from bounce_mjx.runs.writing import CheckpointWriter
from bounce_mjx.training.setup import set_up_jax


class ShipCommand(StrictModel):
    """The command line."""

    run: Annotated[Path, tyro.conf.Positional]
    """A run's folder (its best checkpoint), or a checkpoint in it."""
    name: Literal[tuple(POLICIES)] = PRETRAINED
    """Name of the policy in the package."""
    out: Path | None = None
    """Folder to write, by default the policy's own; an existing one is replaced."""


def main(args: Sequence[str] | None = None) -> None:
    """Runs the command line."""
    with exit_on_user_error():
        command = parse(
            ShipCommand,
            sys.argv[1:] if args is None else args,
            prog="benchmarks/ship.py",
            description="Makes the policy that comes with the package from a run.",
        )
        set_up_jax()
        out = command.out or Path(POLICIES[command.name])
        ship(command.run, out, Console(), command.name)


def ship(run: Path, out: Path, console: Console, name: str = PRETRAINED) -> None:
    """Evaluates the policy of a run in the nominal world, and writes it with its config, its
    results and its ONNX file to `out`.

    Raises:
      UserError: there is no policy, it misses a result, or the folder cannot be written.
    """
    if out.exists() and not (out / CONFIG_FILE).is_file():
        raise UserError(f"--out {out} is not a folder that this command made; give another")
    checkpoint = find_checkpoint(run)
    trained_with = load_run_config(checkpoint.run)
    if trained_with.env.mjcf is not None:
        raise UserError(
            f"{checkpoint.run} was trained with --mjcf {trained_with.env.mjcf}, which is not "
            "part of the package; give a run of the package's own arm"
        )
    policy = read_policy(checkpoint, trained_with)
    report, physics, _ = run_interruptible(
        evaluate_policy,
        policy,
        trained_with.env,
        networks_of(trained_with.ppo),
        EvaluationOptions(nominal=True),
    )
    console.print(results_table(report, f"{checkpoint.folder}, {physics}"))
    console.print(details_line(report), highlight=False)
    if not report.passed:
        raise UserError(f"the policy of {run} misses a result; train longer or give another run")

    made_by = load_results(checkpoint.run)
    # The location of the run's folder is not part of the result.
    config = trained_with.model_copy(update={"log_dir": runs_folder(trained_with.env.task)})
    results = {
        "command": f"python train_jax.py --config {POLICIES[name]}/{CONFIG_FILE}",
        "seed": config.seed,
        "device": "unknown" if made_by is None else made_by.device,
        "best_steps": checkpoint.steps,
        "evaluation": {
            "command": f"bounce-mjx eval {name} --nominal",
            "seed": DEFAULT_SEED,
            "physics": physics,
            "device": jax.devices()[0].device_kind,
            "jax": jax.__version__,
        },
        **report.to_dict(),
    }
    try:
        with tempfile.TemporaryDirectory(dir=out.absolute().parent) as scratch:
            made = Path(scratch) / name
            made.mkdir()
            save_config(made, config)
            writer = CheckpointWriter(made, config)
            writer.save(("best",), checkpoint.steps, policy, results=results)
            writer.close()
            if writer.problem():
                raise UserError(f"{writer.problem()}; free space or give another --out")
            onnx_file = export_onnx(best_checkpoint(made))
            (made / f"{name}.onnx").write_bytes(onnx_file)
            for other in _policies_inside(out):
                other.rename(made / other.name)
            shutil.rmtree(out, ignore_errors=True)
            made.rename(out)
    except OSError as error:
        raise UserError(
            f"--out {out} cannot be written ({error.strerror}); give another folder"
        ) from error
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    console.out(f"written: {out} ({size / 1000:.0f} kB)", highlight=False)


def _policies_inside(out: Path) -> list[Path]:
    """Folders of other policies in the folder of a policy."""
    return [path.parent for path in out.glob(f"*/{CONFIG_FILE}")]


if __name__ == "__main__":
    main()
