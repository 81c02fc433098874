"""Reading of a log, whatever its kind."""

from collections.abc import Sequence
from pathlib import Path

import mujoco

from bounce_mjx.errors import UserError
from bounce_mjx.identify.bags import Topics, is_bag, read_bag
from bounce_mjx.identify.log import Log, check, in_one_clock, read_csv
from bounce_mjx.robot.model import find_addresses, joint_names


def read_log(
    path: Path, model: mujoco.MjModel, topics: Topics, names: Sequence[str] = ()
) -> tuple[Log, list[str]]:
    """Reads and checks the CSV file or the ROS bag of a robot's run.

    Args:
      model: the robot.
      names: the log's names of the robot's joints, in the robot's order; by default the model's.

    Returns:
      The log in one clock, and warnings for an identification, a sentence each.

    Raises:
      UserError: as `read_csv`, `read_bag`, `check` and `in_one_clock`, or the names do not fit.
    """
    own = joint_names(model)
    names = tuple(names) or own
    if not len(set(names)) == len(names) == len(own):
        raise UserError(
            f"--joint-names gives {len(names)} names, {len(set(names))} of them different, and "
            f"the robot has the {len(own)} joints {', '.join(own)}; give the log's name of each, "
            "in this order"
        )
    log = read_bag(path, names, topics) if is_bag(path) else read_csv(path, names)
    warnings = check(log, names, model.jnt_range[list(find_addresses(model).arm_joints)])
    log = in_one_clock(log)
    return log, [*log.notes, *warnings]
