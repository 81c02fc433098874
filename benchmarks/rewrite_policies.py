"""Writes the policies that come with the package in this version's format, for maintainers:
`python benchmarks/rewrite_policies.py`. Their numbers stay as they are."""

import shutil
from pathlib import Path

import jax
import numpy as np

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


def main() -> None:
    for folder in POLICIES.values():
        rewrite(resource_path(folder))


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
