"""Makes a policy that comes with the package from a run, for maintainers:
`python benchmarks/ship.py RUN --name NAME`.

A policy that misses a result is refused, on the episodes that its results.json reports. Do not try
runs until one passes: choose the run by other seeds first (`bounce-mjx eval RUN --seed SEED`)."""

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import jax
from rich.console import Console

from bounce_mjx.config.command_line import Flag, parse
from bounce_mjx.config.settings import StrictModel
from bounce_mjx.deploy.export import export_onnx
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.evaluation.config import DEFAULT_SEED, EvaluationOptions
from bounce_mjx.evaluation.policy_evaluation import PolicyEvaluation, evaluate_policy
from bounce_mjx.learning.policy import networks_of
from bounce_mjx.reports.tables import details_line, results_table
from bounce_mjx.resources import ARM_POLICIES, POLICIES, PRETRAINED, resource_path
from bounce_mjx.runs.checkpoints import (
    NETWORKS,
    POLICY,
    read_networks,
    read_policy,
    save_checkpoint,
)
from bounce_mjx.runs.config import CONFIG_FILE, ROBOT, TrainConfig, load_run_config, runs_folder
from bounce_mjx.runs.creation import copy_robot, write_config
from bounce_mjx.runs.folders import CHECKPOINTS, Checkpoint, best_checkpoint, find_checkpoint
from bounce_mjx.runs.layers import read_preset
from bounce_mjx.runs.progress import RESULTS_FILE, load_results
from bounce_mjx.runs.storage import MANIFEST_FILE, to_json, write_atomically
from bounce_mjx.training.setup import set_up_jax


class ShipCommand(StrictModel):
    """The command line."""

    run: Annotated[Path, Flag(is_positional=True)]
    """A run's folder (its best checkpoint), or a checkpoint in it."""
    name: Literal[tuple(POLICIES)] = PRETRAINED
    """Name of the policy in the package; an arm's is of a run with that arm as --robot."""
    networks: bool = False
    """Also the value network, so that a training can start from the policy."""
    out: Path | None = None
    """Folder to write, by default the policy's own; an existing one is replaced."""


def main(args: Sequence[str] | None = None) -> None:
    """Runs the command line."""
    with exit_on_user_error():
        command = parse(
            ShipCommand,
            sys.argv[1:] if args is None else args,
            prog="benchmarks/ship.py",
            description="Makes a policy that comes with the package from a run.",
        )
        set_up_jax()
        out = command.out or resource_path(POLICIES[command.name])
        ship(command.run, out, Console(), command.name, command.networks)


def ship(
    run: Path, out: Path, console: Console, name: str = PRETRAINED, networks: bool = False
) -> None:
    """Evaluates the policy of a run in the nominal world, and writes it with its config, its
    results and its ONNX file to `out`.

    Args:
      networks: whether its value network is written too.

    Raises:
      UserError: there is no policy, it misses a result, or the folder cannot be written.
    """
    if out.exists() and not (out / CONFIG_FILE).is_file():
        raise UserError(f"--out {out} is not a folder that this command made; give another")
    checkpoint = find_checkpoint(run)
    trained_with = _with_packaged_arm(checkpoint.run, load_run_config(checkpoint.run), name)
    policy = read_policy(checkpoint, trained_with)
    evaluation = evaluate_policy(
        policy,
        trained_with.env,
        networks_of(trained_with.ppo),
        EvaluationOptions(nominal=True),
    )
    report = evaluation.report
    console.print(results_table(report, f"{checkpoint.folder}, {evaluation.engine}"))
    console.print(details_line(report), highlight=False)
    if not report.passed:
        raise UserError(f"the policy of {run} misses a result; train longer or give another run")
    write_policy(checkpoint, trained_with, evaluation, out, name, networks)
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    console.out(f"written: {out} ({size / 1000:.0f} kB)", highlight=False)


def _with_packaged_arm(run: Path, config: TrainConfig, name: str) -> TrainConfig:
    """The config with the MJCF as the arm's config names it, in a Python package, in place of the
    run's copy, whose meshes are too large to ship.

    Raises:
      UserError: the run is of another arm than the policy's name says.
    """
    if name not in ARM_POLICIES:
        if config.env.mjcf is not None:
            raise UserError(
                f"{run} was trained with --mjcf {config.env.mjcf}, and {name} is a policy of the "
                "package's own arm; give one of its runs"
            )
        return config
    mjcf = read_preset(Path("default"), robot=Path(name)).env.mjcf
    with tempfile.TemporaryDirectory() as scratch:
        copy_robot(mjcf, Path(scratch))
        files = [folder / ROBOT / MANIFEST_FILE for folder in (Path(scratch), run)]
        if not files[1].is_file() or files[0].read_bytes() != files[1].read_bytes():
            raise UserError(
                f"{run} was trained with another arm than {mjcf}; give a run with --robot {name}"
            )
    return config.model_copy(update={"env": config.env.model_copy(update={"mjcf": mjcf})})


def write_policy(
    checkpoint: Checkpoint,
    trained_with: TrainConfig,
    evaluation: PolicyEvaluation,
    out: Path,
    name: str,
    networks: bool = False,
) -> None:
    """Writes the folder of a policy, as `ship` does.

    Raises:
      UserError: the folder cannot be written.
    """
    report = evaluation.report
    items = {POLICY: read_policy(checkpoint, trained_with)}
    if networks:
        params, statistics, _ = read_networks(checkpoint, trained_with)
        items[NETWORKS] = {"params": params, "statistics": statistics}
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
            "physics": evaluation.engine,
            "device": jax.devices()[0].device_kind,
            "jax": jax.__version__,
        },
        **report.to_dict(),
    }
    try:
        with tempfile.TemporaryDirectory(dir=out.absolute().parent) as scratch:
            made = Path(scratch) / name
            made.mkdir()
            write_config(made, config)
            save_checkpoint(made, config, checkpoint.steps, items, report=report)
            write_atomically(made / RESULTS_FILE, to_json(results))
            onnx_file = export_onnx(best_checkpoint(made))
            (made / f"{name}.onnx").write_bytes(onnx_file)
            replaced = Path(scratch) / "replaced"
            replaced.mkdir()
            replace_policy(out, made, replaced)
    except OSError as error:
        raise UserError(
            f"--out {out} cannot be written ({error.strerror}); give another folder"
        ) from error


def replace_policy(out: Path, made: Path, replaced: Path) -> None:
    """Moves a policy from `out` to `replaced`, and another from `made` to `out`. Other folders in
    `out`, which are those of other policies, are not touched.

    Raises:
      OSError: a file cannot be moved.
    """
    out.mkdir(exist_ok=True)
    for path in list(out.iterdir()):
        if path.is_file() or path.name in (CHECKPOINTS, ROBOT):
            path.rename(replaced / path.name)
    for path in list(made.iterdir()):
        path.rename(out / path.name)


if __name__ == "__main__":
    main()
