"""What a task is made of. The tasks themselves, one file each, are in `bounce_mjx.tasks`.

    task.py      `Task`, and what an environment gives it and gets: `Start`, `Step`, `TaskStep`
    rewards.py   the terms of a reward, as settings with a formula
    flight.py    the free flight of the ball, for rewards and observations
    results.py   what judges a policy
    shown.py     what viewers and reports draw

A task's file reads `from bounce_mjx import task`, and has each of these names as `task.NAME`; the
settings and the observation of the world, which it extends, are among them. It goes in this order:
constants, reward terms, observation, `Config`, then the task with its start, its step (reward, end,
metrics), its quantities of the observation, its results, and what is shown.
"""

from bounce_mjx.config.settings import StrictModel
from bounce_mjx.task.flight import GRAVITY, Flight, closest, flight
from bounce_mjx.task.results import (
    Episodes,
    Figure,
    Result,
    mean_and_margin,
    mean_of_events,
    root_mean_square,
    share_of_episodes,
    share_of_events,
)
from bounce_mjx.task.rewards import (
    Gaussian,
    Near,
    Proportional,
    RewardTerm,
    gaussian,
    horizontal_distance,
    length,
    safe_sqrt,
    term_names,
    weighted_terms,
)
from bounce_mjx.task.shown import Curve, Histogram, Hits, Marker, Recording
from bounce_mjx.task.task import Moment, Start, Step, Tally, Task, TaskStep, Values, latest
from bounce_mjx.world.config import (
    PADDLE_HOME,
    ActionConfig,
    Command,
    NumBalls,
    ResetConfig,
    WorldConfig,
)
from bounce_mjx.world.observation import History, Kinematics, ObservationConfig, Quantity
from bounce_mjx.world.randomization import RandomizationConfig
