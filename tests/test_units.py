"""A setting in a wrong unit, without an effect, or that no episode survives is refused by name."""

import re
from typing import ClassVar

import jax
import numpy as np
import pydantic
import pytest
import yaml

from bounce_mjx import task
from bounce_mjx.config.validation import validate
from bounce_mjx.env.env import Env
from bounce_mjx.errors import UserError
from bounce_mjx.runs.config import TrainConfig
from bounce_mjx.training.faults import why_unlearnable
from bounce_mjx.world.config import Goal

WRONG = """
default_joint_angles: [0, 40, 110, 0, -60, 0]            # degrees
ball_init_pos: [588.56, 0, 450]                          # mm
target_height_range: [400, 600]                          # mm
target_height_range: [0.02, 0.04]                        # over the floor, not over the paddle
action_scale: 1.15                                       # degrees
control_dt: 10                                           # ms
episode_seconds: 20000                                   # ms
max_joint_velocity: 360                                  # degrees a second
min_ball_height: 50                                      # mm
max_horizontal_distance: 0.15                            # less than the paddle's own distance
reset: {joint_angles: 5.7}                               # degrees
reward: {height: {scale: 150}}                           # mm
reward: {velocity_matching: {desired_velocity: 500}}     # mm/s
randomization: {action_latency: [20, 40]}                # ms
randomization: {ball_latency: [8, 30]}                   # ms
randomization: {paddle_tilt: [-3, 3]}                    # degrees
randomization: {paddle_offset: [-5, 5]}                  # mm
randomization: {ball_radius: [19, 20]}                   # mm, where a factor is due
randomization: {push_speed: [100, 200]}                  # mm/s
randomization: {push_speed: [0.1, 0.2], push_interval: [2000, 3000]}  # ms
robot: {paddle: {half_size: [0.2, 0.2, 0.01], mass: 5}}  # does nothing without robot.site
robot: {site: s, paddle: {half_size: [50, 65, 3.5]}}     # mm
robot: {site: s, paddle: {mass: 100}}                    # g
robot: {site: s, ball: {radius: 19}}                     # mm
robot: {limits: {velocity: [180], acceleration: [9]}}    # degrees a second
robot: {limits: {torque: [0.001, 1, 1, 1, 1, 1]}}        # kN m
ball_init_pos: [0.589, 0.589, 0.45]                      # beside the paddle
max_joint_velocity: 60                                   # turns a minute
reward: {controlled_upward: {max_ideal_velocity: 0.3}}   # below min_ideal_velocity
randomization: {gravity_tilt: [-1, 1]}                   # degrees
randomization: {joint_frictionloss: [0, 1000]}           # mN m
randomization: {torque_limit: [0.001, 0.002]}            # kN m
randomization: {link_mass: [1000, 1001]}                 # g, where a factor is due
randomization: {ball_mass: [0.0027, 0.003]}              # kg, where a factor is due
randomization: {armature: [0.001, 0.002]}                # kg m^2, where a factor is due
randomization: {servo_gain: [1000, 1001]}                # N m/rad, where a factor is due
randomization: {servo_damping: [0.001, 0.002]}           # where a factor is due
randomization: {goal_interval: [0.01, 0.02]}          # one control step
action: {base: target, max_lead: 0.001}                  # less than an action moves
action: {max_lead: 0.3}                                  # does nothing with the base measured
randomization: {push_interval: [1, 2]}                   # does nothing without push_speed
robot: {site: s, ball: {mass: 2.7}}                      # g
robot: {site: s, paddle: {position: [0, 0, 190]}}        # mm
robot: {site: s, paddle: {quaternion: [0, 0, 0, 0]}}     # no orientation
robot: {site: s, servo_stiffness: [20e+6, 20e+6]}        # N mm/rad
robot: {site: s, servo_damping: [2e+6, 2e+6]}            # N mm s/rad
robot: {site: s, servo_force_limit: [150000, 150000]}    # N mm
robot: {site: s, servo_force_limit: [0.001, 0.001]}      # kN m
robot: {limits: {velocity: [3], acceleration: [20000]}}  # degrees a second squared
robot: {limits: {torque: [150000]}}                      # N mm
robot: {gravity_compensation: 100}                       # %
physics_dt: 1                                            # ms
control_dt: 100                                          # Hz
friction: 30                                             # %
action_scale: 20                                         # mrad
reset: {ball_position: 10}                               # mm
reset: {joint_velocities: 57}                            # degrees a second
action: {base: target, max_lead: 8.6}                    # degrees
randomization: {restitution: [75, 90]}                   # %
randomization: {camera_rate: [0.06, 0.12]}               # kHz
randomization: {frame_drop: [5, 10]}                     # %
randomization: {ball_position_noise: [0.3, 0.5]}         # cm
randomization: {ball_position_bias: [-0.5, 0.5]}         # cm
randomization: {ball_velocity_noise: [50, 100]}          # mm/s
randomization: {joint_angle_noise: [0, 0.06]}            # degrees
randomization: {joint_velocity_noise: [1, 3]}            # degrees a second
randomization: {joint_velocity_bias: [-3, 3]}            # degrees a second
randomization: {encoder_bias: [-1, 1]}                   # degrees
randomization: {servo_offset: [-0.5, 0.5]}               # degrees
randomization: {servo_lag: [10, 45]}                     # ms
randomization: {contact_friction: [20, 60]}              # %
randomization: {paddle_offset: [-0.5, 0.5]}              # cm
randomization: {link_mass: [90, 110]}                    # %
randomization: {ball_radius: [95, 105]}                  # %
randomization: {ball_start: [-30, 30]}                   # mm
randomization: {joint_start: [-5, 5]}                    # degrees
randomization: {goal_interval: [3000, 4000]}          # ms
default_joint_angles: [0, 0.111, 0.306, 0, -0.167, 0]    # turns
target_height_range: [40, 60]                            # cm
max_joint_velocity: true                                 # a switch is no number
friction: true                                           # the same, where null is allowed
target_height_range: [true, 2]                           # and in a list
randomization: {restitution: [0.8, 0.9], shares: {restitution: true}}  # and in a mapping
randomization: {paddle_tilt: [[false, 0.1], [0, 0.1]]}   # and in a list of lists
"""


def config(name: str, **env):
    return validate(TrainConfig, {"task": name, "env": env}, "my.yaml").env


def names(values: dict, prefix: str = "") -> list[str]:
    """The keys of nested settings without a group, and the groups of such keys."""
    inner = [names(v, f"{prefix}{k}.") for k, v in values.items() if isinstance(v, dict)]
    leaves = [k for k, v in values.items() if not isinstance(v, dict)]
    return [*leaves, *[prefix.rstrip(".")] * bool(leaves and prefix), *sum(inner, [])]


def test_noise_that_the_policy_does_not_see_is_named() -> None:
    noise = {"ball_velocity_noise": (0.0, 0.1), "ball_position_noise": (0.0, 0.01)}
    seen = {"ball_position": 1, "ball_velocity": 0}
    env = config("bounce", randomization=noise, observation=seen)
    assert env.unseen_noise == ("ball_velocity_noise",)
    assert not config("bounce", randomization=noise).unseen_noise


@pytest.mark.parametrize("line", WRONG.strip().splitlines(), ids=lambda line: line.split("#")[0])
def test_a_wrong_unit_is_refused_by_name(line: str) -> None:
    values = yaml.safe_load(line)
    with pytest.raises(UserError) as caught:
        Env(config("bounce", **values))
    message = str(caught.value)
    assert any(name in message for name in names(values)), message
    assert "\n" not in message and len(message) < 300


@pytest.mark.parametrize(
    "name, env, reason",
    [
        ("juggle", {"height_range": (0.5, 0.4)}, "height_range: (0.5, 0.4) is not a range"),
        ("juggle", {"height_range": (350, 550)}, "height_range is 350"),
        ("juggle", {"home": (0.6, 0.0, -0.5)}, "height_range has the height -0.15 m, which is not"),
        ("track", {"height_range": (0.0, 0.4)}, "height_range is 0.0"),
        ("track", {"speed_range": (50, 300)}, "speed_range is 50"),
        ("track", {"path_size": 120}, "path_size is 120"),
        ("catch", {"ball_init_pos": (-1.5, 1.5, 0.0723)}, "ball_init_pos is 2.12 m from the base"),
        ("balance", {"ball_init_pos": (0.59, 0.0, 0.02)}, "ball_init_pos has the height 0.02 m"),
    ],
)
def test_a_range_of_a_task_is_refused_by_name(name: str, env: dict, reason: str) -> None:
    with pytest.raises(UserError, match="my.yaml|paddle") as caught:
        Env(config(name, **env))
    assert reason in str(caught.value)


# What a world can hold as well: a number in a wrong unit that is a sensible one in the right unit.
ALLOWED = """
randomization: {ball_mass: [2.7, 3]}                     # g: a factor, of a ball of 7 g
randomization: {servo_gain: [80, 120]}                   # %: a factor, of very stiff servos
randomization: {camera_rate: [8, 33]}                    # ms: a slow camera
randomization: {joint_angle_noise: [0, 0.03]}            # degrees: a coarse encoder
randomization: {goal_interval: [0.05, 0.1]}           # minutes: goals that hardly rest
reset: {joint_velocities: 0.57}                          # degrees a second: a quick start
"""

ACCEPTED = """
# the edges of what was measured: a soft paddle, a table-tennis ball, arms heavier than the model
bounce: {randomization: {restitution: [0.55, 0.55]}}
bounce: {robot: {site: s, ball: {mass: 0.0027}}}
bounce: {randomization: {link_mass: [5, 20], joint_frictionloss: [0, 100]}}
# an encoder of 512 counts a turn, a camera with 5 cm of noise
bounce: {randomization: {joint_angle_noise: [0.0, 0.012], ball_position_noise: [0.0, 0.05]}}
# servos of a small arm and of a gantry
bounce: {robot: {site: s, servo_stiffness: [5], servo_damping: [0.1], servo_force_limit: [0.3]}}
bounce: {robot: {site: s, servo_stiffness: [2e+6], servo_damping: [5e+4],
  servo_force_limit: [1e+4]}}
# a 3 m gantry
bounce: {default_joint_angles: [3, -3, 1.5], ball_init_pos: [3, -3, 2], min_ball_height: 1.5,
  target_height_range: [2, 2.5], max_horizontal_distance: 4, action_scale: 0.1}
# a small arm
bounce: {ball_init_pos: [0.12, 0, 0.2], target_height_range: [0.15, 0.25], min_ball_height: 0.02,
  max_horizontal_distance: 0.3, action_scale: 0.1, max_joint_velocity: 12}
# balls: golf, tennis, basketball, steel, balloon
bounce: {robot: {site: s, ball: {radius: 0.0214, mass: 0.0459}}}
bounce: {robot: {site: s, ball: {radius: 0.033, mass: 0.058}}}
bounce: {robot: {site: s, ball: {radius: 0.12, mass: 0.62}}}
bounce: {robot: {site: s, ball: {radius: 0.01, mass: 0.033}}}
bounce: {robot: {site: s, ball: {radius: 0.15, mass: 0.02}}}
bounce: {randomization: {ball_radius: [1.1, 6.3], ball_mass: [0.5, 230]}}
# a soft paddle
bounce: {randomization: {restitution: [0.5, 0.6]}}
# a slow robot with a slow camera, and a fast one
bounce: {randomization: {action_latency: [0.1, 0.3], camera_rate: [15, 30]}}
bounce: {physics_dt: 0.0005, control_dt: 0.001}
# high throws, and a path far from the base
juggle: {height_range: [1, 3], max_distance: 4}
track: {home: [1.5, 0.5, 1], path_size: 0.5}
"""


def test_a_sensible_number_is_accepted_whatever_unit_was_meant() -> None:
    """Of 90 wrong units and values, six cannot be told from a world that someone may want."""
    lines = ALLOWED.strip().splitlines()
    for line in lines:
        config("bounce", **yaml.safe_load(line))
    assert (len(lines), len(WRONG.strip().splitlines())) == (6, 84)


@pytest.mark.parametrize("case", re.findall(r"^\w[^#]+?\n(?=\w|#|$)", ACCEPTED, re.MULTILINE))
def test_other_arms_and_balls_are_accepted(case: str) -> None:
    ((name, env),) = yaml.safe_load(case).items()
    config(name, **env)


class Reward(task.StrictModel):
    low: task.Gaussian = task.Gaussian()
    slow: task.Gaussian = task.Gaussian()


class Mistyped(task.Task):
    """A task with the mistakes of `wrong`."""

    wrong: ClassVar[str] = ""

    class Config(task.WorldConfig):
        reward: Reward = Reward()

        @property
        def goals(self) -> dict[str, Goal]:
            return {"height": Goal(0.4, 0.6, "m", hidden=True)}

    @property
    def curves(self) -> tuple[task.Curve, ...]:
        return (task.Curve("task/error", "eror" if self.wrong == "curve" else "error"),)

    def reset(self, start: task.Start) -> tuple[()]:
        return ()

    def next_goal(self, state: tuple[()], goal: task.Values) -> task.Values:
        if self.wrong == "key left out":
            return {}
        if self.wrong == "key given":
            return goal | {"hieght": goal["height"]}
        return goal

    def step(self, state: tuple[()], step: task.Step) -> task.TaskStep:
        low, slow = step.truth.ball_position[2], step.truth.ball_velocity[2]
        terms = {"term": {"low": low, "slwo": slow}, "term left out": {"low": low}}
        values = terms.get(self.wrong, {"low": low, "slow": slow})
        reward = task.weighted_terms(self.config.reward, **values)
        return task.TaskStep((), reward, low < 0.0, {"error": low})


@pytest.mark.parametrize(
    "wrong, reason",
    {
        "curve": "the curve task/error names a metric that there is not, eror; there are: error",
        "key given": "next_goal of the task Mistyped .* names a goal that .* not, hieght",
        "key left out": "Mistyped .* lacks the goal height; there are: height",
        "term": "names a term of the reward that there is not, slwo; there are: low, slow",
        "term left out": "weighted_terms lacks the term of the reward slow; there are: low, slow",
    }.items(),
)
def test_a_mistyped_name_in_a_task_is_one_sentence(wrong: str, reason: str, monkeypatch) -> None:
    env = Env(Mistyped.Config())
    jax.eval_shape(env.reset, jax.random.key(0))
    monkeypatch.setattr(Mistyped, "wrong", wrong)
    with pytest.raises(UserError, match=reason):
        jax.eval_shape(env.reset, jax.random.key(0))


def test_a_term_that_may_be_none_is_refused() -> None:
    """It would be left out of the reward in silence."""
    group = pydantic.create_model(
        "Terms", __base__=task.StrictModel, low=(task.Near | None, task.Near())
    )
    with pytest.raises(UserError, match="^low in Terms may be a term of the reward or something"):
        task.weighted_terms(group(), 0.0)


@pytest.mark.parametrize("kind", [task.Near, task.Gaussian, task.Proportional])
def test_a_ready_made_term_that_gets_the_inputs_of_others_is_refused(kind: type) -> None:
    group = pydantic.create_model("Terms", __base__=task.StrictModel, still=(kind, kind()))
    assert float(task.weighted_terms(group(), ("others",), still=0.0)["still"]) in (0.0, 1.0)
    with pytest.raises(UserError, match=f"the term still is a {kind.__name__}, which takes a num"):
        task.weighted_terms(group(), ("others",))


def test_a_task_has_its_own_config() -> None:
    with pytest.raises(UserError, match="the task Other has no Config of its own"):
        type("Other", (Mistyped,), {})
    # Nor another task's, whose environments it would change.
    with pytest.raises(UserError, match="the task Other has the Config of Mistyped, .* extends"):
        type("Other", (Mistyped,), {"Config": Mistyped.Config})
    assert type(Env(Mistyped.Config()).task) is Mistyped


def first_block(ended=64.0, too_fast=0.0, non_finite=0.0, height=1.0, fault=0.0) -> dict:
    """Metrics of two seeds and four iterations of 8 environments and 8 steps."""
    named = {
        "episode/ended": ended, "task/too_fast": too_fast, "task/non_finite": non_finite,
        "reward/height": height, "reward/position": -1.0, "fault": fault,
    }  # fmt: skip
    return {name: np.broadcast_to(value, (2, 4)) for name, value in named.items()}


FIRST = TrainConfig(ppo={"num_envs": 8, "rollout_length": 8})
LATE, NAN = np.array([0.0, 0.0, 3.0, 3.0]), np.array([1.0, 1.0, 1.0, np.nan])


@pytest.mark.parametrize(
    "block, reason",
    [
        (first_block(ended=6.0), None),
        (first_block(ended=0.0, height=0.9e5), None),
        # The learning diverged, not the settings: an iteration after the fault counts no more.
        (first_block(ended=0.0, height=NAN, fault=LATE), None),
        # Another seed learns.
        (first_block(ended=np.array([[64.0], [1.0]])), None),
        (first_block(ended=0.0, height=np.array([[np.nan], [1.0]])), None),
        (first_block(), r"lasts 0\.01 s .* an end of the task bounce;"),
        (first_block(too_fast=60.0), r"lasts 0\.01 s .* max_joint_velocity;"),
        (first_block(non_finite=64.0), "the physics, which is not finite"),
        (first_block(ended=7.0), r"lasts 0\.091 s"),
        (
            first_block(ended=0.0, height=-1.1e5),
            "height is -1.1e.05 on average, not within 10000 after",
        ),
        (first_block(ended=0.0, height=NAN), "height is nan on average"),
    ],
)
def test_a_first_block_without_a_chance_is_refused(block: dict, reason: str | None) -> None:
    found = why_unlearnable(block, FIRST)
    assert re.search(reason, found) if reason else found is None


def test_a_short_time_limit_is_no_fault() -> None:
    short = FIRST.model_copy(update={"env": config("bounce", episode_seconds=0.05)})
    assert why_unlearnable(first_block(ended=16.0), short) is None
