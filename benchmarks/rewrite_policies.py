"""Writes the policies that come with the package in this version's format, for maintainers:
`python benchmarks/rewrite_policies.py`, and with `--onnx` their ONNX files alone. Their numbers
stay as they are."""

import argparse
import shutil
from pathlib import Path

import jax
import numpy as np

from bounce_mjx.deploy.export import export_onnx
from bounce_mjx.errors import UserError, exit_on_user_error
from bounce_mjx.resources import POLICIES, resource_path
from bounce_mjx.runs.checkpoints import (
    NETWORKS,
    POLICY,
    read_networks,
    read_policy,
    read_record,
    save_checkpoint,
)
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import CHECKPOINTS, best_checkpoint, write_config
from bounce_mjx.training.setup import set_up_jax


def main() -> None:
    """Runs the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--onnx", action="store_true", help="only the ONNX files")
    parser.add_argument("policies", nargs="*", help="names; all by default")
    command = parser.parse_args()
    with exit_on_user_error():
        names = command.policies or list(POLICIES)
        for name in names:
            if name not in POLICIES:
                raise UserError(f"{name} is no policy of the package; give {', '.join(POLICIES)}")
        set_up_jax()
        for name in names:
            run = resource_path(POLICIES[name])
            if not command.onnx:
                rewrite(run)
            onnx_file = run / f"{name}.onnx"
            onnx_file.write_bytes(export_onnx(best_checkpoint(run)))
            print(f"written: {onnx_file}", flush=True)


def rewrite(run: Path) -> None:
    """Writes a policy's config and its best checkpoint anew, with the same arrays and record, and
    removes the old checkpoints. If that fails, the old ones stay."""
    config = load_run_config(run)
    checkpoint = best_checkpoint(run)
    record = read_record(checkpoint)
    policy = read_policy(checkpoint, config)
    items = {POLICY: policy}
    if (checkpoint.folder / NETWORKS).is_dir():
        params, statistics, _ = read_networks(checkpoint, config)
        items[NETWORKS] = {"params": params, "statistics": statistics}
    old = run / "old"
    # Otherwise the new checkpoint would not have the number of its steps.
    (run / CHECKPOINTS).rename(old)
    try:
        write_config(run, config)
        save_checkpoint(run, config, record.steps, items, record.progress, record.report)
        written = read_policy(best_checkpoint(run), load_run_config(run))
        jax.tree.map(np.testing.assert_array_equal, written, policy)
    except BaseException:
        shutil.rmtree(run / CHECKPOINTS, ignore_errors=True)
        old.rename(run / CHECKPOINTS)
        raise
    shutil.rmtree(old)
    print(f"written: {best_checkpoint(run).folder}", flush=True)


if __name__ == "__main__":
    main()
