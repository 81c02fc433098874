"""Writes the policies that come with the package in this version's format, for maintainers:
`python benchmarks/rewrite_policies.py`, and with `--onnx` their ONNX files alone. Their numbers
stay as they are."""

import argparse
import shutil
from pathlib import Path

import jax
import numpy as np

from bounce_mjx.deploy.export import export_onnx
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
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--onnx", action="store_true", help="the ONNX files alone")
    parser.add_argument("policies", nargs="*", default=list(POLICIES), help="names")
    given = parser.parse_args()
    set_up_jax()
    for name in given.policies:
        run = resource_path(POLICIES[name])
        if not given.onnx:
            rewrite(run)
        (run / f"{name}.onnx").write_bytes(export_onnx(best_checkpoint(run)))
        print(f"written: {run / f'{name}.onnx'}", flush=True)


def rewrite(run: Path) -> None:
    """Writes a policy's config and its best checkpoint anew, and removes the old checkpoints."""
    checkpoint, config = best_checkpoint(run), load_run_config(run)
    policy, progress = read_policy(checkpoint, config), read_record(checkpoint).progress
    items = {POLICY: policy}
    if (checkpoint.folder / NETWORKS).is_dir():
        params, statistics, _ = read_networks(checkpoint, config)
        items[NETWORKS] = {"params": params, "statistics": statistics}
    old = run / "old"
    (run / CHECKPOINTS).rename(old)
    write_config(run, config)
    save_checkpoint(run, config, checkpoint.steps, items, progress)
    written = read_policy(best_checkpoint(run), load_run_config(run))
    jax.tree.map(np.testing.assert_array_equal, written, policy)
    shutil.rmtree(old)
    print(f"written: {best_checkpoint(run).folder}")


if __name__ == "__main__":
    main()
