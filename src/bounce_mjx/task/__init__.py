"""What a task is made of: `Task`, its settings, reward terms, results and pictures."""

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
