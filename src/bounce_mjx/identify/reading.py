"""Reading of a log, whatever its kind."""

from pathlib import Path

import mujoco

from bounce_mjx.identify.bags import Topics, is_bag, read_bag
from bounce_mjx.identify.log import Log, check, in_one_clock, read_csv
from bounce_mjx.robot.model import find_addresses, joint_names


def read_log(path: Path, model: mujoco.MjModel, topics: Topics) -> tuple[Log, list[str]]:
    """Reads and checks the CSV file or the ROS bag of a robot's run.

    Args:
      model: the robot.

    Returns:
      The log in one clock, and warnings for an identification, a sentence each.

    Raises:
      UserError: as `read_csv`, `read_bag` and `check`.
    """
    names = joint_names(model)
    log = read_bag(path, names, topics) if is_bag(path) else read_csv(path, names)
    warnings = check(log, names, model.jnt_range[list(find_addresses(model).arm_joints)])
    return in_one_clock(log), warnings
