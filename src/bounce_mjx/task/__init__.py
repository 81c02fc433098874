"""What a task is made of: `Task`, its settings, reward terms, results and pictures."""

from bounce_mjx.config.settings import StrictModel
from bounce_mjx.task.quantities import latest
from bounce_mjx.task.results import (
    Episodes,
    Figure,
    Result,
    mean_and_margin,
    mean_of_events,
    share_of_episodes,
    share_of_events,
)
from bounce_mjx.task.rewards import (
    RewardTerm,
    gaussian,
    horizontal_distance,
    safe_sqrt,
    term_names,
    weighted_terms,
)
from bounce_mjx.task.shown import Curve, Histogram, Hits, Marker, Recording
from bounce_mjx.task.task import Moment, Start, Step, Tally, Task, TaskStep
from bounce_mjx.world.config import Command, ResetConfig, WorldConfig
from bounce_mjx.world.observation import History, Kinematics, ObservationConfig, Quantity

__all__ = [
    "Command",
    "Curve",
    "Episodes",
    "Figure",
    "Histogram",
    "History",
    "Hits",
    "Kinematics",
    "Marker",
    "Moment",
    "ObservationConfig",
    "Quantity",
    "Recording",
    "ResetConfig",
    "Result",
    "RewardTerm",
    "Start",
    "Step",
    "StrictModel",
    "Tally",
    "Task",
    "TaskStep",
    "WorldConfig",
    "gaussian",
    "horizontal_distance",
    "latest",
    "mean_and_margin",
    "mean_of_events",
    "safe_sqrt",
    "share_of_episodes",
    "share_of_events",
    "term_names",
    "weighted_terms",
]
