"""Reading of a log, whatever its kind."""

from collections.abc import Callable
from pathlib import Path

import mujoco

from bounce_mjx.identify.bags import Topics, is_bag, read_bag
from bounce_mjx.identify.log import Log, check, in_one_clock, read_csv
from bounce_mjx.robot.model import find_addresses, joint_names


def read_log(path: Path, model: mujoco.MjModel, topics: Topics, warn: Callable[[str], None]) -> Log:
    """Reads and checks the CSV file or the ROS bag of a robot's run.

    Args:
      model: the robot.
      warn: called with a sentence for each oddity.

    Raises:
      UserError: as `read_csv`, `read_bag` and `check`.
    """
    names = joint_names(model)
    log = read_bag(path, names, topics) if is_bag(path) else read_csv(path, names)
    for warning in check(log, names, model.jnt_range[list(find_addresses(model).arm_joints)]):
        warn(warning)
    return in_one_clock(log)
