"""Tasks: what the arm and the ball are to do. Those of the package have a file each, as yours has.

    task.py      `Task`, and what an environment, a report and a viewer give it and get from it
    rewards.py   the terms of a reward, as settings with a formula
    flights.py   the ball's free flight, its apex and its landing
    results.py   what judges a policy
    registry.py  how a task is found by its name

    bounce.py    the task of the original specification, with its terms in bounce_rewards.py
    track.py     the ball bounces over a point that moves along a path of paths.py
    balance.py   the ball rests on the paddle and follows a point on it
    catch.py     a thrown ball comes to rest on the paddle
    juggle.py    two or three balls on one paddle

A task's file reads `from bounce_mjx import task`, and has each name that is imported below as
`task.NAME`; the settings and the observation of the world, which it extends, are among them. It
goes in this order: constants, reward terms, observation, `Config`, then the task with its start,
its step (reward, end, metrics), its quantities of the observation, its results, and what is shown.
"""

from bounce_mjx.config.settings import StrictModel
from bounce_mjx.task.flights import GRAVITY, Flight, closest, flight
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
    changes,
    gaussian,
    horizontal_distance,
    length,
    safe_sqrt,
    term_names,
    weighted_terms,
)
from bounce_mjx.task.task import (
    Curve,
    Histogram,
    Hits,
    Marker,
    Moment,
    Recording,
    Start,
    Step,
    Tally,
    Task,
    TaskStep,
    Values,
    latest,
)
from bounce_mjx.world.config import (
    PADDLE_HOME,
    ActionConfig,
    Goal,
    NumBalls,
    ResetConfig,
    WorldConfig,
)
from bounce_mjx.world.limits import Limit, Limits, check_within, is_beyond, target_heights
from bounce_mjx.world.observation import History, Kinematics, ObservationConfig, Quantity
from bounce_mjx.world.randomization import RandomizationConfig
