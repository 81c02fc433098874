"""`load_policy`: loads a policy by name, from an ONNX file, or from a run."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bounce_mjx.deploy.policy import DeployedPolicy
from bounce_mjx.errors import UserError
from bounce_mjx.resources import POLICIES, policy_folder


def load_policy(
    policy: str | os.PathLike,
    task: str | None = None,
    joint_names: Sequence[str] | Mapping[str, str] | None = None,
    env: Any = None,
) -> DeployedPolicy:
    """Loads a policy that runs without JAX.

    Args:
      policy: the name of a policy that comes with the package, "pretrained", "robust",
        "robust_small", or that of a task such as "juggle" or of an arm; a `.onnx` file from
        `bounce-mjx export`; or a run's folder or a checkpoint in it, which is first exported with
        JAX. A folder of that name comes first.
      task: FILE.py:CLASS, for a run of a task in a file, which is code.
      joint_names: the driver's names of the joints in the driver's order, such as `fr3_joint1`;
        angles, velocities, actions and commands then have this order. A name belongs to the joint
        whose name it ends with; for others, a mapping from the driver's names to the policy's.
      env: an environment of this package, such as one of `gymnasium.make`, in place of a robot;
        then `step` takes its observations.

    Raises:
      UserError: there is no such policy, the file is damaged, the names are not those of the
        policy's robot, or the environment is not the policy's.
    """
    path = Path(policy)
    source = str(policy)
    if (folder := policy_folder(policy)) is not None:
        path = folder / f"{policy}.onnx"
        source = f"the policy {policy}"
    try:
        model = _export(path, task) if path.is_dir() else path.read_bytes()
    except OSError as error:
        raise UserError(
            f"the policy {path} cannot be read ({error.strerror}); give {', '.join(POLICIES)}, "
            "a .onnx file or a run's folder"
        ) from error
    loaded = DeployedPolicy(model, source)
    if env is not None:
        if joint_names is not None:
            raise UserError("joint_names are of a robot's driver, and env is given; leave one out")
        _use_environment(loaded, str(policy), env)
    if joint_names is not None:
        loaded.use_joints(joint_names)
    return loaded


def _use_environment(policy: DeployedPolicy, name: str, env: Any) -> None:
    """Lets a policy take the observations of an environment.

    Raises:
      UserError: the environment is not the policy's.
    """
    from bounce_mjx.deploy.interface import check_interface, interface_in, interface_of
    from bounce_mjx.deploy.wrappers import environments_in

    advice = f"make the environment with policy={name!r}"
    environments = environments_in(env)
    for environment in environments:
        interface = interface_of(environment.config)
        check_interface(interface_in(policy.metadata), interface, name, advice)
    # Any one, as they have the policy's observation.
    config = environments[0].config
    places = {}
    for part in config.layout.parts:
        first = config.layout[part.name].start
        places[part.name] = slice(first, first + part.size)
    policy.use_observations(places, config.layout.size)


def check_names(names: Sequence[str], joints: Sequence[str], option: str) -> tuple[str, ...]:
    """A driver's names of a robot's joints.

    Args:
      joints: the robot's own names.
      option: what has the driver's names, for the error.

    Raises:
      UserError: their number differs, or a name is given twice.
    """
    if not len(set(names)) == len(names) == len(joints):
        raise UserError(
            f"{option} has {len(names)} names, {len(set(names))} of them different, and the robot "
            f"has the {len(joints)} joints {', '.join(joints)}; give one name for each, in this "
            "order"
        )
    return tuple(names)


def _export(run: Path, task: str | None) -> bytes:
    """The ONNX file of a run's policy."""
    try:
        from bounce_mjx.deploy.export import export_onnx
        from bounce_mjx.runs.config import load_run_config
        from bounce_mjx.runs.folders import find_checkpoint
    except ImportError as error:
        raise UserError(
            f"the run {run} must be exported, for which {error.name} is missing; use bounce-mjx "
            "export on the machine that trained it, and give the .onnx file"
        ) from error
    checkpoint = find_checkpoint(run)
    load_run_config(checkpoint.run, task)
    return export_onnx(checkpoint)
