"""What a task is made of: `Task`, its settings, its reward terms and its results."""

from bounce_mjx.task.quantities import latest
from bounce_mjx.task.rewards import (
    RewardTerm,
    gaussian,
    horizontal_distance,
    safe_sqrt,
    term_names,
    weighted_terms,
)
from bounce_mjx.task.task import Start, Step, Task, TaskStep
from bounce_mjx.world.config import Command, WorldConfig
from bounce_mjx.world.observation import History, Kinematics, ObservationConfig, Quantity

__all__ = [
    "Command",
    "History",
    "Kinematics",
    "ObservationConfig",
    "Quantity",
    "RewardTerm",
    "Start",
    "Step",
    "Task",
    "TaskStep",
    "WorldConfig",
    "gaussian",
    "horizontal_distance",
    "latest",
    "safe_sqrt",
    "term_names",
    "weighted_terms",
]
