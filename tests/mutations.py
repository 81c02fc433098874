"""Deliberate faults, one at a time: a test that `uv run pytest` runs must catch each.

    python tests/mutations.py          # all faults, in a copy of the tree
    python tests/mutations.py 3 7      # some

It is not part of CI: a fault needs new compiled programs, so all of them take half an hour.
"""

# ruff: noqa: E501

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

CHECKOUT = Path(__file__).parent.parent
COPIED = "src", "tests", "mjcf", "configs", "pretrained", "examples", "benchmarks", "docs"
SINGLE = "pyproject.toml", "train_jax.py", "README.md", "CHANGELOG.md", "CONTRIBUTING.md"

REWARDS, BOUNCE = "task/bounce_rewards.py", "task/bounce.py"
ENV, VECTOR, ACTUATION = "env/env.py", "env/vector.py", "world/actuation.py"
LIMITS = "world/limits.py"
SENSING, CONTACT = "world/sensing.py", "robot/contact.py"
PPO, STATISTICS = "learning/ppo.py", "learning/statistics.py"
CONTROL = "physics/control.py"
BALL, NORMALS = "physics/fused/ball.py", "physics/fused/normals.py"
FRICTION, RUB = "physics/friction.py", "physics/fused/friction.py"
EXPORT = "deploy/export.py"

# What is wrong, the file, its text, the faulty text, and the test that catches it.
FAULTS = [
    ("the height error has the other sign", REWARDS,
     "return self.target_height - self.ball_position[2]",
     "return self.ball_position[2] - self.target_height", "test_rewards.py -k terms_equal"),
    ("a penalty for being out of position is a reward", REWARDS,
     "-self.magnitude * jax.nn.sigmoid((inputs.err_xy", "self.magnitude * jax.nn.sigmoid((inputs.err_xy", "test_rewards.py -k terms_equal"),
    ("the action's change is a sum", REWARDS,
     "inputs.action - inputs.last_action", "inputs.action + inputs.last_action", "test_rewards.py -k terms_equal"),
    ("alignment is boosted between bounces", REWARDS,
     "jnp.where(inputs.bounced, self.bounce_boost, 1.0)", "jnp.where(inputs.bounced, 1.0, self.bounce_boost)", "test_rewards.py -k terms_equal"),
    ("joint velocities are rewarded", REWARDS,
     "return -jnp.sum(jnp.square(inputs.joint_velocity))", "return jnp.sum(jnp.square(inputs.joint_velocity))", "test_rewards.py -k terms_equal"),
    ("an apex must be above the target to count", BOUNCE,
     '"target_height"] - config.apex_tolerance', '"target_height"] + config.apex_tolerance', "test_env.py -k bounce_count"),
    ("the count restarts at 0", BOUNCE, "state.n_bounces + 1.0, 1.0)", "state.n_bounces + 1.0, 0.0)", "test_env.py -k bounce_count"),
    ("every rising step near the paddle is a bounce", BOUNCE,
     "bounced = rising & ~state.rising & near", "bounced = rising & near", "test_env.py -k bounce"),
    ("a ball may leave to the side", LIMITS, "| (abs(y) > value)", "| (abs(x) > value)", "test_env.py -k beyond_its_bound"),
    ("the apex is that of the whole episode", BOUNCE,
     "apex=jnp.where(bounced, height, jnp.maximum(state.apex, height))",
     "apex=jnp.maximum(state.apex, height)", "test_env.py -k apex"),
    ("the first two seconds are judged", BOUNCE, "settled = moment.seconds > settling", "settled = moment.seconds > 0.0", "test_evaluation.py -k settling_takes"),
    ("a NaN action passes", ENV, '"non_finite": ~(finite & is_number)', '"non_finite": ~finite', "test_env.py -k nan_action"),
    ("joints may move twice as fast as allowed", ENV,
     "> self.config.max_joint_velocity", "> 2.0 * self.config.max_joint_velocity", "test_env.py -k fast_joint"),
    ("the last action is never remembered", ENV,
     "physics=physics, last_action=action, actuation", "physics=physics, actuation", "test_env.py -k reports_the_terms"),
    ("the joint angles are read in another order", ENV,
     "joint_angles=_entries(qpos, addresses.arm_qpos)",
     "joint_angles=_entries(qpos, addresses.arm_qpos[::-1])", "test_env.py -k mujocos_state"),
    ("the joints' servo targets are swapped", ACTUATION,
     "self._addresses.actuators, gears * values)",
     "self._addresses.actuators, gears * jnp.roll(values, 1))", "test_env.py -k substeps_of_mujoco"),
    ("the time limit is one step late", VECTOR,
     "truncated = (clock >= episode_steps)", "truncated = (clock > episode_steps)", "test_vector.py -k at_the_limit"),
    ("the final observation is the next episode's first", VECTOR,
     "final_observation=stepped.obs.T", "final_observation=env_state.obs.T", "test_vector.py -k equals_a_loop"),
    ("an action is a control step too late", ACTUATION,
     "whole = jnp.floor(latency + 1e-4)", "whole = jnp.floor(latency + 1e-4) + 1.0", "test_randomization.py -k late_and_lagging"),
    ("a late action is early", ACTUATION,
     "previous=older.ctrl",
     "ctrl=older.ctrl, previous=newer.ctrl", "test_randomization.py -k late_and_lagging"),
    ("the servo's lag is counted in control steps", ACTUATION,
     'world["servo_lag"] / (control_dt / num_substeps)', 'world["servo_lag"] / control_dt', "test_randomization.py -k late_and_lagging"),
    ("a late target waits one physics step more", CONTROL,
     "jnp.where(step < control.switch, control.previous, control.ctrl)",
     "jnp.where(step <= control.switch, control.previous, control.ctrl)", "test_randomization.py -k late_and_lagging"),
    ("the air pushes the ball", CONTROL, "tuple(-air_drag * speed", "tuple(air_drag * speed", "test_randomization.py -k brakes"),
    ("the restitution is clipped", CONTACT,
     "jnp.interp(restitution, restitutions", "jnp.interp(jnp.maximum(restitution, 0.8), restitutions", "test_randomization.py -k drops_bounce"),
    ("the range of a goal shrinks", ENV,
     "first + (1.0 - first) * progress", "1.0 - (1.0 - first) * progress", "test_randomization.py -k about_its_middle"),
    ("the ball is seen a step too late", SENSING,
     "age = latency\n", "age = latency + 1.0\n", "test_sensors.py -k latency_without"),
    ("lost pictures are seen, and seen ones lost", SENSING,
     'chance >= world["frame_drop"]', 'chance < world["frame_drop"]', "test_sensors.py -k lost_pictures"),
    ("a velocity from differences ignores the pictures' age", SENSING,
     "jnp.maximum(last_age - age, 1e-3)", "jnp.maximum(last_age, 1e-3)", "test_sensors.py -k latency_without"),
    ("the encoders' bias has the other sign", SENSING,
     'angles = angles + world["encoder_bias"]', 'angles = angles - world["encoder_bias"]', "test_sensors.py -k measured_angles"),
    ("a history has the oldest value first", SENSING,
     "with_newest(history, measured[name])", "jnp.concatenate([history[1:], measured[name][None]])", "test_sensors.py -k bounces_are"),
    ("the bootstrap of a time-out is dropped", PPO,
     "jnp.where(rollout.truncated, timeout_value, next_value)", "next_value", "test_ppo.py -k bootstraps"),
    ("advantages leak across a time-out", PPO,
     "(~(terminated | truncated))", "(~terminated)", "test_ppo.py -k their_definition"),
    ("PPO takes the larger of its two objectives", PPO,
     "jnp.minimum(ratio * samples.advantage, clipped", "jnp.maximum(ratio * samples.advantage, clipped", "test_ppo.py -k objective"),
    ("a large KL divergence raises the learning rate", PPO,
     "jnp.where(is_large, 1.0 / _LEARNING_RATE_FACTOR, factor)", "jnp.where(is_large, _LEARNING_RATE_FACTOR, factor)", "test_ppo.py -k kl_divergence"),
    ("the variance is measured from the old mean", STATISTICS,
     "jnp.sum(from_old_mean * from_new_mean", "jnp.sum(from_old_mean * from_old_mean", "test_policy.py -k statistics_equal"),
    ("the ball moves with the velocity before the step", BALL,
     "position = ball.position + velocity * dt", "position = ball.position + ball.velocity * dt", "test_physics.py -k random_states"),
    ("a contact pulls", NORMALS, "return [jnp.maximum(first_linear / pivot, 0.0)]", "return [first_linear / pivot]", "test_physics.py -k random_states"),
    ("friction turns the slip round", FRICTION, "minimum(to_stop, to_slide)", "to_slide", "test_friction.py -k never_adds"),
    ("friction ignores the coefficient", FRICTION, "minimum(to_stop, to_slide)", "to_stop", "test_friction.py -k rigid_formula"),
    ("the paddle does not feel friction", RUB, "half_generalised)) * scale", "half_generalised)) * 0.0", "test_friction.py -k given_friction"),
    ("friction of two balls turns one of them alone", RUB,
     "_after_impulse(first_model, first, first_lever, -impulse)", "_after_impulse(first_model, first, first_lever * 0.0, -impulse)", "test_friction.py -k of_two_balls"),
    ("the gradient of friction is not finite at a small slip", FRICTION, "_NO_SLIP = 1e-16", "_NO_SLIP = 1e-24", "test_friction.py -k at_every_slip"),
    ("a contact lasts a whole period of its spring", CONTACT,
     "return (math.pi / duration) ** 2", "return (2.0 * math.pi / duration) ** 2", "test_randomization.py -k lasts_as"),
    ("an exported policy has a wrong normaliser", EXPORT,
     "networks.act(policy, jnp",
     "networks.act(policy._replace(normalizer=policy.normalizer._replace(mean=0.0 * policy.normalizer.mean)), jnp", "test_deploy.py -k onnx_equals"),
    ("the robot's targets move against the action", "deploy/controller.py",
     "base + self.metadata.action_scale * action", "base - self.metadata.action_scale * action", "test_deploy.py -k servo_targets_lead"),
    ("a velocity from differences takes every step for as long as the others", "deploy/network.py",
     "max(picture.taken - view.taken, _SHORTEST)", "self.metadata.control_dt", "test_deploy.py -k real_time_between"),
    ("a late step goes on at its speed", "deploy/controller.py",
     "course = self.motion.stopped(course)", "pass", "test_motion.py -k late_step_goes_on"),
    ("two balls in turn are one at rest", "deploy/flight.py", "> 0.5 * len(beside)", "> 5.0 * len(beside)", "test_motion.py -k two_balls"),
    ("an arm goes home after a lost ball without a word", "deploy/session.py",
     "if not operator.has_word(state):", 'if not operator.has_word(state) and state != "stopped":', "test_bridges.py -k ur_rtde"),
    ("a ball need not fall", "deploy/flight.py",
     "    if fit.ratio > 1.0:", "    if fit.ratio > 1e9:", "test_motion.py -k hand_holds"),
    ("an ended episode still earns its return", "evaluation/statistics.py",
     "jnp.where(running, states.reward, 0.0)", "states.reward", "test_evaluation.py -k up_to_its_end"),
    ("a training waits a hundred times as long for a margin", "runs/progress.py", "PATIENCE = 1.5", "PATIENCE = 150", "test_progress.py -k wait_long"),
    ("a warm start that meets all results ends at once", "runs/progress.py", 'and e["steps"] > 0', "", "test_job.py -k trained_until_a_margin"),
    ("a callback ends the training of the leader alone", "training/job.py",
     "self.ended_by_callback = hosts.any_of(self.ended_by_callback)", "pass", "test_job.py -k several_hosts"),
    ("a damaged checkpoint of a seed is removed", "training/job.py",
     "for folder in self.configs_by_folder():", "for folder in [self.run]:", "test_job.py -k best_policy_is_damaged"),
    ("of equal evaluations the oldest is the best", "runs/progress.py",
     "report.score < self.best.score", "report.score <= self.best.score", "test_progress.py -k equal_evaluations"),
    ("a screening counts as a full evaluation", "evaluation/results.py",
     "return not self.screening, met", "return True, met", "test_progress.py -k equal_evaluations"),
    ("curves have no points of evaluations", "reports/figures.py",
     'f"results/{evaluated}"', 'f"result/{evaluated}"', "test_plot.py -k point_for_each_evaluation"),
    ("steps have other letters", "reports/figures.py",
     'EngFormatter(sep="")', 'EngFormatter(sep="", places=3)', "test_plot.py -k point_for_each_evaluation"),
    ("the band is two deviations wide", "reports/figures.py", "mean - deviation, mean + deviation", "mean - 2.0 * deviation, mean + 2.0 * deviation", "test_plot.py -k one_deviation"),
    ("a curve keeps what was logged first", "reports/curves.py",
     "for event in log.Scalars(name)}", "for event in log.Scalars(name)[::-1]}", "test_plot.py -k logged_last"),
    ("runs of other settings are one group", "reports/curves.py",
     "members_of.setdefault(json.dumps(of_run), [])", 'members_of.setdefault("", [])', "test_plot.py -k differ_in_the_seed"),
    ("values that are no numbers are drawn", "reports/curves.py", "if math.isfinite(value)}", "if True}", "test_plot.py -k numbers_count"),
    ("a panel cuts what is below zero", "reports/figures.py", "if lowest >= 0.0:", "if True:", "test_plot.py -k whole_curve"),
    ("save_every saves at evaluations alone", "training/job.py",
     "(is_asked_for or self.is_evaluated())", "self.is_evaluated()", "test_job.py -k save_every"),
    ("a callback that returns False is ignored", "training/job.py",
     "isinstance(answer, bool | np.bool_) and not answer", "False", "test_job.py -k callback_sees"),
    ("a signal does not stop the training", "training/job.py", "return hosts.any_of(self.stop.requested or self.failure is not None)", "return hosts.any_of(False)", "test_job.py -k signal_saves"),
    ("a signal while the callbacks are closed is lost", "training/job.py",
     "    if job.stop.requested:\n        raise job.stopped(", "    if False:\n        raise job.stopped(", "test_job.py -k callbacks_are_closed"),
    ("a signal during the final evaluation is said to have come after it", "training/job.py",
     "        stops_late = self.must_stop()\n", "        stops_late = stops_early\n", "test_job.py -k final_evaluation"),
    ("the state of several seeds is a policy", "runs/folders.py", "if seeds == [run]:", "if True:", "test_job.py -k no_policy_and_no_damage"),
    ("a checkpoint has the results of the best one", "training/run.py",
     "if checkpoint != folders.best_checkpoint(checkpoint.run):", "if False:", "test_job.py -k history_of_checkpoints"),
    ("two wrong items are choices of one value", "config/validation.py",
     "if is_of_setting and _items(other) == _items(first):", "if is_of_setting:", "test_commands.py -k one_sentence"),
    ("a stopped training saves nothing", "training/job.py",
     "        if self.needs_save:\n            self.save()\n", "", "test_job.py -k signal_saves"),
    ("a training ends a block too early", "training/job.py",
     "self.steps >= self.config.total_steps", "self.steps + self.steps_per_block >= self.config.total_steps", "test_job.py -k whole_block_nearest"),
    ("results end a training that was not to stop", "training/job.py",
     "return self.config.stop_when_solved and may_end", "return may_end", "test_job.py -k results_have_a_margin"),
    ("a policy that was not saved stays the best", "training/seeds.py",
     "        if has_failed:\n", "        if False:\n", "test_job.py -k could_not_be_saved"),
    ("a resumed training forgets its best policy", "training/seeds.py",
     "return Best(policy, record.report, record.steps, checkpoint.number)", "return None", "test_job.py -k knows_the_best"),
    ("the newest policy is the best", "training/seeds.py",
     "        if is_best:\n", "        if True:\n", "test_job.py -k knows_the_best"),
    ("a diverged seed is named one iteration late", "training/faults.py",
     "at iteration {first + index}", "at iteration {first + index + 1}", "test_job.py -k divergence_ends"),
    ("rewards in another unit are trained", "training/faults.py", "MAX_REWARD = 1e4", "MAX_REWARD = 1e40", "test_job.py -k cannot_be_trained"),
    ("what a resumed run may not change is changed", "runs/layers.py",
     "if changed := differing_keys(resumed, config) - RESUMABLE_KEYS:", "if changed := set():", "test_commands.py -k one_sentence"),
    ("a file wins over a flag", "runs/layers.py",
     "layers = [*self.below, *above]", "layers = [*above, *self.below]", "test_settings.py -k wins_over_those"),
    ("the machine's preset wins over an algorithm's defaults", "runs/layers.py",
     "layers[Rank.ALGORITHM] = _changed_defaults(start.algorithm_config)", "layers[Rank.MACHINE] = _changed_defaults(start.algorithm_config) + layers[Rank.MACHINE]", "test_settings.py -k algorithms_own_default"),
    ("a world loses its own randomisation", "runs/worlds.py",
     'merged({"env": {"randomization": default}}, {"env": _settings_for(task, world)})', 'merged({"env": world.settings}, {"env": {"randomization": default}})', "test_settings.py -k wins_over_those"),
    ("another version's setting is taken for a slip", "runs/config.py", "if key is None:", "if True:", "test_runs.py -k another_version"),
    ("the oldest run is the newest", "runs/folders.py",
     "return max(_intact_checkpoints(run, place), key", "return min(_intact_checkpoints(run, place), key", "test_checkpoints.py -k newest_checkpoint"),
    ("the arm goes home ten times as fast", "deploy/supervisor.py", "_HOME_SPEED = 0.3", "_HOME_SPEED = 3.0", "test_motion.py -k was_moved"),
    ("an unknown goal of a task is ignored", "commands/goals.py",
     "if name not in env.goals:", "if False:", "test_commands.py -k one_sentence"),
    ("a pause shortens the path of the ball", "viewers/display.py", "~advanced & ~is_same", "~advanced", "test_frames.py -k path_of"),
    ("an end between two pictures is lost", "viewers/simulation.py",
     "return values[before] | (", "return values[before] & (", "test_frames.py -k every_episode"),
    ("strangers open the live page", "viewers/guard.py", "return name in names", "return True", "test_page.py -k own_page"),
    ("a slider loses the values of the training", "viewers/world.py",
     "spans[slider.term] = min(low), max(high)", "spans[slider.term] = low[0], high[0]", "test_simulation.py -k slider_reaches"),
    ("a command that is held acts at its stamp", "identify/following.py",
     "return following.delay - _hold(log)", "return following.delay", "test_identify.py -k when_they_are_due"),
    ("a set point is half a step late", "identify/following.py",
     "commanded(log, times + 0.5 * dt)", "commanded(log, times)", "test_identify.py -k when_they_are_due"),
    ("spin lifts a ball to the other side", "identify/flight.py",
     "braking + np.cross(lift, velocity)", "braking - np.cross(lift, velocity)", "test_identify.py -k drag_and_spin"),
    ("milliseconds of a log are seconds", "identify/reading.py", '"ms": 1e-3,', '"ms": 1.0,', "test_logs.py -k stated_units"),
    ("a camera's drift is doubled", "identify/log.py",
     "log.picture_times + drifts * slope", "log.picture_times - drifts * slope", "test_logs.py -k clock_of_its_own"),
    ("a fall is a time-out", "adapters/sb3.py",
     "bool(truncated[i] and not terminated[i])", "bool(terminated[i])", "test_sb3.py -k single_environments"),
    ("an episode takes the seed of the one before", "adapters/gymnasium/environments.py",
     "self._is_drawn[mask] = False", "self._is_drawn[mask] = True", "test_gymnasium.py -k vector_equals"),
    ("pictures of the hand that throws a ball are of its flight", "deploy/samples.py",
     "if not seen.paddle or taken < seen.let_go:", "if not seen.paddle:", "test_motion.py -k thrown_from_a_hand"),
    ("an episode's return is its last reward", "adapters/gymnasium/environments.py",
     "self._returns += reward", "self._returns = np.array(reward, float)", "test_gymnasium.py -k vector_equals"),
    ("every end is a time-out for rsl_rl", "adapters/torch/rsl_rl_env.py",
     '"time_outs": result.truncated', '"time_outs": result.done', "test_torch.py -k gets_time_outs"),
]  # fmt: skip


def copy_tree(folder: Path) -> None:
    for name in COPIED:
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(CHECKOUT / name, folder / name, ignore=ignored, symlinks=True)
    for name in SINGLE:
        shutil.copy(CHECKOUT / name, folder)


def status(folder: Path, tests: list[str]) -> int:
    """Exit status of pytest for some tests in the copy of the tree."""
    files, keywords = zip(*(test.split(" -k ") for test in tests), strict=True)
    names = sorted({f"tests/{file}" for file in files})
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", *names]
    command += ["-k", " or ".join(sorted(set(keywords)))]
    path = os.pathsep.join([str(folder / "src"), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": path}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True).returncode


def is_caught(folder: Path, file: str, old: str, new: str, test: str) -> bool:
    """Whether the test fails in the copy of the tree with the fault."""
    path = folder / "src/bounce_mjx" / file
    text = path.read_text(encoding="utf-8")
    assert text.count(old) == 1, f"{file} has {old!r} {text.count(old)} times"
    path.write_text(text.replace(old, new), encoding="utf-8")
    try:
        # Other statuses than 1 are errors of pytest's own: no test of that name, for example.
        return status(folder, [test]) == 1
    finally:
        path.write_text(text, encoding="utf-8")


def main() -> None:
    chosen = [FAULTS[int(word) - 1] for word in sys.argv[1:]] or FAULTS
    missed = 0
    with tempfile.TemporaryDirectory(prefix="bounce_mjx_mutations_") as name:
        copy_tree(Path(name))
        tests = [fault[-1] for fault in chosen]
        assert status(Path(name), tests) == 0, "a test fails without a fault"
        print("all tests pass without a fault", flush=True)
        for fault in chosen:
            caught = is_caught(Path(name), *fault[1:])
            missed += not caught
            print(f"{'caught' if caught else 'MISSED'}: {fault[0]} ({fault[-1]})", flush=True)
    sys.exit(missed > 0)


if __name__ == "__main__":
    main()
