"""Rehearses an arm's first day without the arm: `bounce-mjx rehearse POLICY` or `--robot ARM`."""

import contextlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from bounce_mjx.commands.goals import GivenGoals, parse_with_goals
from bounce_mjx.commands.which_policy import OtherWorld, WhichPolicy
from bounce_mjx.config.command_line import Flag
from bounce_mjx.config.settings import Finite, NonNegative, NonNegativeInt, Positive
from bounce_mjx.errors import UserError
from bounce_mjx.resources import policy_folder
from bounce_mjx.task.registry import DEFAULT, find_task

if TYPE_CHECKING:
    from bounce_mjx.deploy.recorder import Recorder
    from bounce_mjx.deploy.session import Session
    from bounce_mjx.rehearsal.arm import SimulatedArm
    from bounce_mjx.world.config import WorldConfig

_PROG = "bounce-mjx rehearse"
_YAML = (".yaml", ".yml")
_SIZE = (640, 480)
# Half of a screen's: where no GPU renders, a picture takes longer than what it shows.
_FILM_FPS = 25
# Half of the box around the paddle's home that is taken by default, m.
_BOX = 0.5
# Length of a planned motion, s.
_MOTION_SECONDS = 20.0


class RehearseCommand(WhichPolicy):
    """Runs a robot's program against MuJoCo's C engine, in place of the robot: a policy under its
    supervisor, or, of an arm without a policy, the motion of bounce-mjx excite. Delays, noise and
    the camera are those of a world."""

    policy: Annotated[Path | None, Flag(metavar="[POLICY]", is_positional=True)] = None
    """A run's folder (its best checkpoint), a checkpoint in it, latest for the newest run, an .onnx
    file, a policy that comes with the package, or the config of an arm without a policy, a YAML
    file. The default is the newest run, or the task's policy in the package if there is no run."""
    robot: Path | None = None
    """Config of the arm: the file that bounce-mjx adopt wrote, or the name of one in
    configs/robots/. With a policy, it has to be the policy's arm, and its servos and limits count;
    without one, the arm plays a motion."""
    world: OtherWorld = None
    motion: Path | None = None
    """Motion for an arm without a policy, a file of bounce-mjx excite; by default, what that plans
    in 20 s."""
    seconds: Positive = 20.0
    """Simulated time of a policy, s."""
    box: tuple[Finite, Finite, Finite, Finite, Finite, Finite] | None = None
    """Lowest and highest x, y and z that the paddle may reach, m, in this order: X Y Z X2 Y2 Z2. By
    default, 0.5 m to each side of its home."""
    fault: str | None = None
    """Fault that comes in the first episode, such as camera, or stuck:3 for the third joint; a
    wrong word lists them."""
    fault_at: NonNegative = 1.5
    """Time of the fault after the start of the episode, or of the motion, s."""
    seed: NonNegativeInt | None = None
    """Seed of the world, sampled as in an episode of the training. By default, each term has the
    middle of its range."""
    log: Path | None = None
    """CSV file for the log, which bounce-mjx identify reads."""
    film: Path | None = None
    """File for a video, .mp4, .webp or .gif."""


def main(args: Sequence[str]) -> None:
    """Runs the command line; exits with 1 if the arm stopped without a fault, and with 2 on a
    mistake."""
    command, given_goals = parse_with_goals(RehearseCommand, args, prog=_PROG)
    _check_files(command)
    is_arm = command.policy is not None and command.policy.suffix in _YAML
    if is_arm and command.robot is not None:
        raise UserError(f"{command.policy} and --robot {command.robot} are two arms; give one")
    if is_arm or (command.policy is None and command.robot is not None):
        _rehearse_motion(command, command.policy or command.robot)
    else:
        _rehearse_policy(command, given_goals)


def _rehearse_policy(command: RehearseCommand, given_goals: GivenGoals) -> None:
    if command.motion is not None:
        raise UserError("--motion is for an arm without a policy; leave it out, or give --robot")
    import numpy as np

    from bounce_mjx.deploy.loading import load_policy
    from bounce_mjx.deploy.motion import paddle_position
    from bounce_mjx.deploy.session import play
    from bounce_mjx.rehearsal.arm import goals_in_turn
    from bounce_mjx.rehearsal.operator import SimulatedOperator

    file = _policy_file(command)
    config = _config_of_policy(command, file)
    given = given_goals.checked(config)
    goals = goals_in_turn(config, {name: (value,) for name, value in given.items()})
    arm = _arm(command, config)
    # Last, as that of a run is compiled.
    policy = load_policy(file)
    metadata = policy.metadata
    home = paddle_position(metadata, np.array(metadata.default_joint_angles))
    box = np.array(command.box or [*(home - _BOX), *(home + _BOX)]).reshape(2, 3)
    print(f"box: --box {' '.join(f'{end:.2f}' for end in box.ravel())}")
    units = {name: wanted.unit for name, wanted in metadata.goals.items()}
    with _log(command, metadata.joint_names, units, metadata.num_balls) as recorder:
        settings = {"box": tuple(box)}
        operator = SimulatedOperator(arm)
        session = play(policy, arm, command.seconds, operator, goals, settings, recorder)
    _tell(command, session, arm)
    _film(command, config, arm, goals)
    _exit_with_status(command, session)


def _policy_file(command: RehearseCommand) -> Path:
    """What `load_policy` loads."""
    if command.policy is not None:
        is_file = command.policy.is_file()
        if is_file or policy_folder(command.policy) is not None:
            # Refuses --log-dir beside it.
            command.folder_for(command.policy)
            return command.policy
    (checkpoint,) = command.choose(command.policy)
    return checkpoint.folder


def _config_of_policy(command: RehearseCommand, policy: Path) -> "WorldConfig":
    """The environment of a policy's training, in the world of the rehearsal.

    Raises:
      UserError: there is none, or --robot is another arm.
    """
    from bounce_mjx.deploy.environments import environment_config, with_settings
    from bounce_mjx.deploy.interface import robot_name
    from bounce_mjx.runs.worlds import OWN, TRAINING, settings_in_world

    config = environment_config(policy=policy, world=command.world or TRAINING)
    if command.robot is None:
        return config
    given = settings_in_world(config.task, OWN, command.robot)
    names = robot_name(config.mjcf), robot_name(given.mjcf)
    poses = config.default_joint_angles, given.default_joint_angles
    if names[0] != names[1] or poses[0] != poses[1]:
        what = f"the arm {names[0]}, and this is {names[1]}"
        if names[0] == names[1]:
            what = f"another start pose of {names[0]}"
        raise UserError(
            f"the policy is for {what}; train one with --robot {command.robot}, or leave "
            "the policy out, and the arm plays a motion"
        )
    return with_settings(config, {"robot": given.robot})


def _rehearse_motion(command: RehearseCommand, robot: Path) -> None:
    from bounce_mjx.deploy.session import replay
    from bounce_mjx.deploy.trajectory import Trajectory, read_trajectory
    from bounce_mjx.identify.excitation import excite
    from bounce_mjx.rehearsal.camera import NoCamera
    from bounce_mjx.runs.worlds import NOMINAL, OWN, settings_in_world

    task = find_task(command.task or DEFAULT)
    arms = settings_in_world(task, OWN, robot)
    config = settings_in_world(arms, command.world or NOMINAL)
    if command.motion is None:
        planned = excite(config, _MOTION_SECONDS, 1.0)
        trajectory = Trajectory(planned.joint_names, planned.times, planned.targets)
    else:
        trajectory = read_trajectory(command.motion)
    arm = _arm(command, config, NoCamera())
    arm.put_balls_away()
    if trajectory.joint_names != arm.joint_names:
        raise UserError(
            f"the motion {command.motion} is of the joints {', '.join(trajectory.joint_names)}, "
            f"and the arm has {', '.join(arm.joint_names)}; plan one for this arm: bounce-mjx "
            f"excite --robot {robot}"
        )
    try:
        with _log(command, arm.joint_names, {}, 1) as recorder:
            away = replay(arm, trajectory, recorder)
    finally:
        _film(command, config, arm, lambda time: {})
    joint = int(away.argmax())
    print(
        f"the arm followed the motion for {trajectory.times[-1]:.1f} s; largest distance from its "
        f"targets {away[joint]:.3f} rad ({arm.joint_names[joint]})"
    )
    if command.log is not None:
        print(f"log: {command.log}")
        print(f"look at it: bounce-mjx identify {command.log} --robot {robot} --inspect")


def _arm(command: RehearseCommand, config: "WorldConfig", camera: Any = None) -> "SimulatedArm":
    """The simulated arm with its world and its fault, of which lines tell."""
    from bounce_mjx.rehearsal.arm import SimulatedArm, in_words, middle, sampled
    from bounce_mjx.rehearsal.faults import Injection, named_fault
    from bounce_mjx.robot.model import joint_names
    from bounce_mjx.world.model import world_model

    seed = command.seed or 0
    world = middle(config) if command.seed is None else sampled(config, seed)
    injection = None
    if command.fault is not None:
        names = joint_names(world_model(config, visual=False))
        act, meaning = named_fault(command.fault, names)
        injection = Injection(act, command.fault_at)
        print(f"fault: {meaning}, after {command.fault_at:g} s")
    arm = SimulatedArm(config, world, seed, injection=injection, camera=camera)
    print(f"arm: {', '.join(arm.joint_names)} at {arm.rate:g} Hz, {in_words(world)}")
    return arm


def _log(
    command: RehearseCommand, names: Sequence[str], units: dict[str, str], balls: int
) -> "contextlib.AbstractContextManager[Recorder | None]":
    from bounce_mjx.deploy.recorder import Recorder

    if command.log is None:
        return contextlib.nullcontext()
    return Recorder(command.log, names, units, balls)


def _check_files(command: RehearseCommand) -> None:
    """Refuses a film or a log that cannot be written, before the rehearsal."""
    from bounce_mjx.runs.storage import check_output

    check_output(command.log, "--log")
    if command.film is not None:
        from bounce_mjx.viewers.video import SUFFIXES, find_ffmpeg

        check_output(command.film, "--film", SUFFIXES)
        find_ffmpeg()


def _film(command: RehearseCommand, config: "WorldConfig", arm: "SimulatedArm", goals: Any) -> None:
    """Writes the film, if there is to be one."""
    if command.film is None:
        return
    from bounce_mjx.env.env import Env
    from bounce_mjx.rehearsal.film import pictures
    from bounce_mjx.viewers.video import VideoWriter

    writer = VideoWriter(command.film, _SIZE, _FILM_FPS)
    writer.write_pictures(pictures(Env(config), arm.path, goals, _SIZE, writer.fps))
    print(f"film: {command.film}")


def _tell(command: RehearseCommand, session: "Session", arm: "SimulatedArm") -> None:
    """Prints what happened."""
    for number, episode in enumerate(session.episodes, start=1):
        bounces = arm.bounces_in(episode.start, episode.seconds)
        end = "until the end"
        if episode.fault is not None:
            end = f"then {episode.fault}: {episode.reason}"
            if command.fault is not None and number == 1:
                after = episode.seconds - command.fault_at
                end += f", {after:.2f} s after the fault" if after >= 0.0 else ", before the fault"
        start = f"episode {number}, from {episode.start:.2f} s"
        print(f"{start}: {episode.seconds:.2f} s, {bounces} bounces, {end}")
    if not session.episodes:
        print(f"no episode began: {session.reason}")
    if command.log is not None:
        print(f"log: {command.log}")


def _exit_with_status(command: RehearseCommand, session: "Session") -> None:
    """Exits with 1 if the arm stopped without a fault that was asked for."""
    has_stopped = any(episode.fault for episode in session.episodes)
    if not session.episodes or (has_stopped and command.fault is None):
        sys.exit(1)
