"""PPO: advantages, learning rate, bootstrapping at time-outs, purity, and that it learns."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optax
import pytest
from jax.flatten_util import ravel_pytree

from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.config import user_code
from bounce_mjx.config.user_code import import_code
from bounce_mjx.env.env import State
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.episodes import make_evaluator
from bounce_mjx.evaluation.results import judge
from bounce_mjx.learning import policy, ppo
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.metrics import matching_metrics
from bounce_mjx.learning.ppo import generalized_advantages
from bounce_mjx.learning.registry import find_algorithm
from bounce_mjx.learning.statistics import Normalizer, init_normalizer, normalize
from bounce_mjx.runs.checkpoints import policy_shapes, read_policy, write_run
from bounce_mjx.runs.config import load_run_config
from bounce_mjx.runs.folders import latest_checkpoint
from bounce_mjx.task import Task
from tiny_runs import settings_of

OBSERVATION = EnvConfig().layout

# Each block of Python on the page about changing PPO is a file of a user's.
PAGE = (Path(__file__).parents[1] / "docs/algorithms.md").read_text(encoding="utf-8")
RECIPES = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)


def recipe(name: str, folder: Path) -> type[ppo.PPO]:
    """The algorithm of that name on the page, found as `--algorithm` finds it."""
    (block,) = (block for block in RECIPES if f"class {name}(" in block)
    (folder / f"{name}.py").write_text(block)
    import_code(folder / f"{name}.py")
    return find_algorithm(name.lower())


def point_of_the_page() -> type:
    """The environment on the page, which has no more than `AnyEnv` asks for."""
    (block,) = (block for block in RECIPES if "class Point:" in block)
    names: dict = {}
    exec(block.split("\n\n\ntrainer =")[0], names)
    return names["Point"]


Point = point_of_the_page()


def plain(tree):
    """`tree` with its random keys converted to numbers."""

    def to_numpy(leaf):
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(leaf) if is_key else leaf)

    return jax.tree.map(to_numpy, tree)


def assert_identical(first, second):
    """Bit for bit."""
    jax.tree.map(np.testing.assert_array_equal, plain(first), plain(second))


def advantages_by_definition(reward, value, next_value, terminated, truncated, discount, lam):
    """Each advantage as a separate sum of discounted errors, forward in time, up to the end of the
    episode."""
    result = np.zeros(reward.shape)
    for t, b in np.ndindex(*reward.shape):
        weight = 1.0
        for k in range(t, len(reward)):
            bootstrap = 0.0 if terminated[k, b] else next_value[k, b]
            result[t, b] += weight * (reward[k, b] + discount * bootstrap - value[k, b])
            if terminated[k, b] or truncated[k, b]:
                break
            weight *= discount * lam
    return result


def random_rollout(seed=0, steps=30, envs=40):
    rng = np.random.default_rng(seed)
    ends = rng.random((steps, envs))
    return {
        "reward": rng.normal(size=(steps, envs)).astype(np.float32),
        "value": rng.normal(size=(steps, envs)).astype(np.float32),
        "next_value": rng.normal(size=(steps, envs)).astype(np.float32),
        "terminated": ends < 0.1,
        "truncated": ends > 0.9,
    }


@pytest.mark.parametrize(("discount", "lam"), [(0.99, 0.95), (0.9, 0.0), (1.0, 1.0)])
def test_advantages_equal_their_definition(discount, lam):
    rollout = random_rollout()
    actual = generalized_advantages(**rollout, discount=discount, gae_lambda=lam)
    expected = advantages_by_definition(*rollout.values(), discount, lam)
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-4)


@pytest.fixture(scope="module")
def rate() -> ppo.PPO:
    """The limit falls over ten iterations of 100 steps each."""
    config = PPOConfig(
        num_envs=10, rollout_length=10, num_minibatches=2, decay_steps=1000,
        max_learning_rate=1e-2, final_max_learning_rate=1e-4, min_learning_rate=1e-5,
        target_kl=0.01,
    )  # fmt: skip
    return ppo.PPO(config, Point(), episode_steps=10)


def test_max_learning_rate_decays_exponentially(rate):
    for iteration, expected in ((0, 1e-2), (5, 1e-3), (10, 1e-4), (11, 1e-4), (10**6, 1e-4)):
        actual = rate.max_learning_rate(jnp.int32(iteration))
        np.testing.assert_allclose(actual, expected, rtol=1e-5)


def adapted(trainer, kl, learning_rate=1e-3, iteration=0):
    metrics = {"policy/kl": jnp.float32(kl)}
    return float(trainer.adapt_learning_rate(learning_rate, metrics, jnp.int32(iteration)))


def test_learning_rate_follows_the_kl_divergence(rate):
    slower, faster = adapted(rate, 0.0201), adapted(rate, 0.0049)
    assert slower < 1e-3 < faster
    np.testing.assert_allclose(slower * faster, 1e-6, rtol=1e-5)
    for kl in (0.0051, 0.01, 0.0199):
        np.testing.assert_allclose(adapted(rate, kl), 1e-3, rtol=1e-6)


def test_learning_rate_stays_in_its_limits(rate):
    np.testing.assert_allclose(adapted(rate, 0.0, 9.9e-3), 1e-2, rtol=1e-6)
    np.testing.assert_allclose(adapted(rate, 0.01, 5e-3, iteration=5), 1e-3, rtol=1e-5)
    np.testing.assert_allclose(adapted(rate, 1.0, 1.01e-5), 1e-5, rtol=1e-6)
    # Without a target it is fixed, whatever its limits.
    fixed = ppo.PPO(rate.config.model_copy(update={"target_kl": 0.0}), Point(), episode_steps=10)
    kept = [adapted(fixed, kl, iteration=i) for kl in (0.0, 1.0) for i in (0, 10)]
    np.testing.assert_allclose(kept, 1e-3, rtol=1e-6)


class TwoStates:
    """An episode starts in the first state; every step leads to the second one."""

    observation_size = 2
    action_size = 1
    backend = "none"
    task = Task

    def __init__(self, first_reward: float, terminates: float = 0.0, hidden: bool = False):
        """Leaving the first state pays `first_reward`, leaving the second one pays 1 and
        terminates the episode if `terminates` is 1. If `hidden`, the two look the same, and only
        the metric n_bounces tells them apart."""
        self.first_reward = first_reward
        self.terminates = terminates
        self.hidden = hidden

    def _state(self, second, reward, done):
        names = ("bounced", "ball_xy_error", "apex_error", "non_finite", "too_fast")
        metrics = dict.fromkeys(names, jnp.zeros(())) | {"n_bounces": second}
        obs = jnp.ones(2) if self.hidden else jnp.stack([1.0 - second, second])
        return State(second, obs, reward, done, metrics)

    def reset(self, rng):
        zero = jnp.zeros(())
        return self._state(zero, zero, zero)

    def step(self, state, action):
        was_second = state.pipeline_state
        reward = jnp.where(was_second > 0, 1.0, self.first_reward)
        return self._state(jnp.ones(()), reward, was_second * self.terminates)


def two_state_config(**changes) -> PPOConfig:
    settings = {
        "num_envs": 16, "rollout_length": 2, "num_minibatches": 2, "hidden_layers": (16,),
        "discount": 0.9, "reward_scale": 0.1, "learning_rate": 3e-3, "target_kl": 0.0,
        "max_learning_rate": 3e-3, "decay_steps": 10**9, "critic_metrics": (),
    }  # fmt: skip
    return PPOConfig(**settings | changes)


def test_time_out_bootstraps_the_old_episodes_last_state():
    """The observation does not tell the two states apart, but a metric of the critic does.

    The second state is worth 0.1 / (1 - 0.9), the first one 0.9 of that. If a time-out led on to
    the first state of the next episode, they would be worth 0.526 and 0.474, and if it counted as
    a termination, as it is in the second training, 0.09 and 0.1.
    """
    config = two_state_config(critic_metrics=("n_bounces",))

    def train(terminates: jax.Array):
        env = TwoStates(0.0, terminates=terminates, hidden=True)
        trainer = ppo.PPO(config, env, episode_steps=2)
        return trainer.run(trainer.init(jax.random.key(0)), 500)

    state, metrics = jax.jit(jax.vmap(train))(jnp.array([0.0, 1.0]))
    networks = policy.make_networks(config, 2, 1)
    seen = jnp.array([[1.0, 1.0, 0.0], [1.0, 1.0, 1.0]])
    values = jax.vmap(
        lambda params, normalizer: networks.value_network.apply(params, normalize(seen, normalizer))
    )(state.params.value, state.statistics.normalizer)
    np.testing.assert_allclose(values, [[0.9, 1.0], [0.09, 0.1]], atol=0.03)
    np.testing.assert_allclose(metrics["episode/return"][:, -1], 1.0, rtol=1e-6)
    np.testing.assert_allclose(metrics["episode/length"][:, -1], 2.0, rtol=1e-6)
    np.testing.assert_array_equal(metrics["reward"][:, -1], 0.5)


class Precise(TwoStates):
    """The reward asks for a precise action."""

    def step(self, state, action):
        state = super().step(state, action)
        return state.replace(reward=-jnp.square(action[0] - 0.3))


@pytest.mark.slow
def test_the_noise_shrinks_to_its_bound():
    """The bounds of the environments have the mean `mean_noise_bound`; the policy is as precise."""
    config = two_state_config(
        num_envs=64, mean_noise_bound=0.2, reward_scale=10.0, learning_rate=1e-2, discount=0.0,
        max_learning_rate=1e-2,
    )  # fmt: skip
    trainer = ppo.PPO(config, Precise(1.0), episode_steps=2)
    state, metrics = jax.jit(lambda key: trainer.run(trainer.init(key), 300))(jax.random.key(0))
    assert 0.2 <= metrics["policy/action_std"][-1] < 0.3
    networks = policy.make_networks(config, 2, 1)
    action = networks.act(ppo.policy_of(state, 2), jnp.eye(2))
    np.testing.assert_allclose(action, 0.3, atol=0.03)


def test_settings_that_no_training_can_have_are_refused():
    with pytest.raises(UserError, match="rollout_length 2 .* episode of 1 "):
        ppo.PPO(two_state_config(), TwoStates(1.0), episode_steps=1)
    config = two_state_config(critic_metrics=("n_bounces", "n_bounce"))
    with pytest.raises(UserError, match="names n_bounce, .* choose from .*n_bounces"):
        ppo.PPO(config, TwoStates(1.0), episode_steps=2)
    config = two_state_config(critic_metrics=("wrold/*",))
    with pytest.raises(UserError, match=r"names wrold/\*, which the environment does not have"):
        ppo.PPO(config, TwoStates(1.0), episode_steps=2)
    assert ppo.PPO(two_state_config(critic_metrics=("world/*",)), TwoStates(1.0), 2)
    with pytest.raises(UserError, match=r"names world/frict\*"):
        matching_metrics(["world/frict*"], ["n_bounces", "world/restitution"])
    # Limits that would change the rate after one minibatch.
    for rate in (0.02, 1e-6):
        with pytest.raises(ValueError, match=f"learning_rate {rate} is not within min_learning"):
            two_state_config(learning_rate=rate, target_kl=0.01)
        assert two_state_config(learning_rate=rate).learning_rate == rate


class Climbing(ppo.PPO):
    """An optimizer whose updates are to be added; the first is 0."""

    def make_optimizer(self):
        return optax.adam(optax.linear_schedule(0.0, 1.0, 100))


class Unmeasured(ppo.PPO):
    """An update of its own, which tells no metric."""

    def update(self, state, samples, key):
        return state, {}


def test_an_optimizer_that_climbs_and_an_update_without_metrics_are_refused():
    with pytest.raises(UserError, match="make_optimizer of Climbing turns a gradient around"):
        Climbing(two_state_config(), TwoStates(1.0), episode_steps=2)
    algorithm = Unmeasured(two_state_config(), TwoStates(1.0), episode_steps=2)
    with pytest.raises(UserError, match="returns no metric loss/gradient_norm"):
        jax.eval_shape(lambda key: algorithm.run(algorithm.init(key), 1), jax.random.key(0))


class Silent(ppo.PPO):
    """A loss of its own, which tells no KL divergence."""

    def loss(self, params, samples):
        total, _ = super().loss(params, samples)
        return total, {"loss/own": total}


def test_any_environment_and_any_loss_train(tmp_path) -> None:
    config = two_state_config(num_envs=64, decay_steps=512, learning_rate=1e-3)
    scheduled = type("Scheduled", (Silent, recipe("Linear", tmp_path)), {})
    trainer = scheduled(config, Point(), episode_steps=8)
    _, metrics = jax.jit(lambda key: trainer.run(trainer.init(key), 5))(jax.random.key(0))
    expected = [1e-3, 7.5e-4, 5e-4, 2.5e-4, 0.0]
    np.testing.assert_allclose(metrics["policy/learning_rate"], expected, rtol=1e-6, atol=1e-12)
    assert np.all(np.isfinite(metrics["loss/own"])) and not np.any(metrics["fault"])
    assert np.all(metrics["reward"] < 0.0)

    silent = Silent(config.model_copy(update={"target_kl": 0.01}), Point(), episode_steps=8)
    with pytest.raises(UserError, match="the loss of Silent returns no metric policy/kl"):
        jax.eval_shape(lambda key: silent.run(silent.init(key), 1), jax.random.key(0))


class Descent(ppo.PPO):
    """Plain gradient descent with a weight decay and a schedule of its own, beside the KL rule."""

    def make_optimizer(self):
        return optax.add_decayed_weights(0.1)

    def learning_rate(self, adapted, iteration):
        return 0.01 * 0.5**iteration


def test_a_schedule_decides_each_minibatch_step(trainer, params):
    """The first of an iteration too, and the KL rule, which has the rate 0.1 here, none."""
    config = trainer.config.model_copy(update={"target_kl": 0.01})
    descent, samples = Descent(config, trainer.env, 100), some_samples(trainer, params)
    flat, unravel = ravel_pytree(params)
    before = ppo.LearnerState(flat, descent.optimizer.init(flat), jnp.float32(0.1))
    step = jax.jit(lambda iteration: descent.minibatch_step(before, samples, unravel, iteration)[0])
    gradient, _ = ravel_pytree(jax.grad(lambda p: trainer.loss(p, samples)[0])(params))
    for iteration, rate in ((0, 0.01), (3, 0.00125)):
        moved = step(jnp.int32(iteration)).params - flat
        downhill = -rate * (gradient + 0.1 * flat)
        np.testing.assert_allclose(moved, downhill, rtol=1e-4, atol=1e-7)


def test_episodes_do_not_all_time_out_together():
    trainer = ppo.PPO(two_state_config(), TwoStates(1.0), episode_steps=1000)
    steps = np.asarray(trainer.init(jax.random.key(0)).env.clock)
    assert steps.min() >= 0 and steps.max() < 1000
    assert len(np.unique(steps)) > 8


@pytest.fixture(scope="module")
def trainer() -> ppo.PPO:
    return ppo.PPO(
        two_state_config(critic_metrics=("n_bounces",)), TwoStates(1.0), episode_steps=100
    )


@pytest.fixture(scope="module")
def params(trainer):
    return jax.jit(trainer.init)(jax.random.key(0)).params


@pytest.mark.slow
def test_training_is_a_function_of_its_key(trainer):
    """And changes every parameter."""
    init, run = jax.jit(trainer.init), jax.jit(lambda state: trainer.run(state, 2))
    first = init(jax.random.key(0))
    after_two = run(first)
    assert_identical(run(init(jax.random.key(0))), after_two)
    other, _ = run(init(jax.random.key(1)))
    for before, a, b in zip(
        *(jax.tree.leaves(x.params) for x in (first, after_two[0], other)), strict=True
    ):
        assert np.any(np.asarray(a) != np.asarray(b)) and np.any(np.asarray(a) != before)


@pytest.mark.usefixtures("float64")
def test_learning_is_in_float32_with_physics_in_float64(trainer):
    """And a jitted `run` takes its own result without another compilation."""
    start = jax.eval_shape(trainer.init, jax.random.key(0))
    state, _ = jax.eval_shape(lambda state: trainer.run(state, 1), start)
    learned = (state.params, state.optimizer[1].nu, state.statistics, state.learning_rate)
    assert {x.dtype for x in jax.tree.leaves(learned)} == {jnp.dtype("float32")}
    types = [
        [(x.shape, x.dtype, x.weak_type) for x in jax.tree.leaves(tree)] for tree in (start, state)
    ]
    assert types[0] == types[1]


def product_types(program) -> list:
    """Types of the matrix products of a program, in their order, also within its calls."""
    types = []
    for equation in program.eqns:
        if equation.primitive.name == "dot_general":
            types.append(equation.outvars[0].aval.dtype)
        for inner in equation.params.values():
            if hasattr(inner, "jaxpr"):
                types += product_types(inner.jaxpr)
    return types


def test_hidden_layers_are_computed_in_bfloat16_and_outputs_not():
    networks = policy.make_networks(two_state_config(), 2, 1, dtype="bfloat16")
    for network in (networks.policy_network, networks.value_network):
        params = network.init(jax.random.key(0))
        assert {x.dtype for x in jax.tree.leaves(params)} == {jnp.dtype("float32")}
        program = jax.make_jaxpr(network.apply)(params, jnp.zeros((1, 2)))
        assert product_types(program.jaxpr) == [jnp.bfloat16, jnp.float32]


def test_an_update_uses_the_normalisation_of_the_next_rollout():
    """If the policy does not change, the KL divergence of an update is the divergence between the
    policy on the rollout's own normalised observations and on the same observations normalised with
    the statistics that include the rollout."""
    config = two_state_config(num_envs=1024, learning_rate=1e-12, min_learning_rate=1e-12)
    trainer = ppo.PPO(config, TwoStates(1.0), episode_steps=2)
    before = jax.jit(trainer.init)(jax.random.key(0))
    after, metrics = jax.jit(lambda state: trainer.run(state, 1))(before)
    networks = policy.make_networks(config, 2, 1)
    (old, deviation), (new, _) = (
        networks.policy_network.apply(
            before.params.policy, normalize(jnp.eye(2), state.statistics.normalizer)
        )
        for state in (before, after)
    )
    of_states = jnp.sum(jnp.square(new - old) / (2.0 * jnp.square(deviation)), axis=-1)
    # All environments start in the first state; half of them then time out and are in the first
    # state again.
    divergence = 0.75 * of_states[0] + 0.25 * of_states[1]
    assert divergence > 1e-5
    np.testing.assert_allclose(metrics["policy/kl"][0], divergence, rtol=0.1)


def test_the_objective_is_the_smaller_of_the_two(trainer, params):
    """Schulman et al. 2017, equation 7, at ratios of 0.5 and 1.5."""
    inputs, action, bound = jnp.ones((4, 3)), jnp.full((4, 1), 0.3), jnp.zeros((4, 1))
    ratio, advantage = np.array([0.5, 0.5, 1.5, 1.5]), np.array([1.0, -1.0, 2.0, -3.0])
    new = trainer.distribution(params, inputs, bound).log_prob(action)
    samples = ppo.Samples(
        inputs, action, new - np.log(ratio), advantage, jnp.zeros(4), bound, init_normalizer(3)
    )
    epsilon = trainer.config.clip_epsilon
    expected = -np.mean([0.5, -(1.0 - epsilon), 2.0 * (1.0 + epsilon), -4.5])
    _, parts = trainer.loss(params, samples)
    np.testing.assert_allclose(parts["loss/policy"], expected, rtol=1e-5)


def some_samples(trainer, params) -> ppo.Samples:
    """Samples of another policy than that of the parameters."""
    rng = np.random.default_rng(0)
    inputs, action = (jnp.float32(rng.normal(size=(64, n))) for n in (3, 1))
    bound, target = jnp.zeros((64, 1)), jnp.float32(rng.normal(size=64))
    log_prob = trainer.distribution(params, inputs, bound).log_prob(action)
    log_prob += 0.3 * target
    return ppo.Samples(inputs, action, log_prob, target, target, bound, init_normalizer(3))


def test_the_examples_term_weighs_the_change_of_the_action(trainer, params):
    import_code(Path(__file__).parents[1] / "examples/smooth_ppo.py")
    name = "smoothppo"
    kind = find_algorithm(name)
    settings = kind.Config(**trainer.config.model_dump(), smoothness_cost=1e5)
    smooth, samples = kind(settings, trainer.env, 100), some_samples(trainer, params)
    (before, _), (after, metrics) = (x.loss(params, samples) for x in (trainer, smooth))
    assert metrics["loss/smoothness"] > 0.0
    expected = 1e5 * float(metrics["loss/smoothness"])
    assert float(after - before) == pytest.approx(expected, rel=1e-3)


def signs_of_the_mirror_image(env: BounceBall) -> tuple[np.ndarray, np.ndarray]:
    """Signs of the observation [29] and of the action [6] in a mirror along y, from geometry."""
    model, arm = env.mj_model, list(env.addresses.arm_qpos)
    data = mujoco.MjData(model)
    data.qpos[arm] = env.config.default_joint_angles
    mujoco.mj_kinematics(model, data)
    # A rotation about an axis along y stays, one about an axis in the mirror's plane turns back.
    along_y = np.abs(data.xaxis[: len(arm), 1])
    np.testing.assert_allclose(along_y, np.round(along_y), atol=1e-9)
    joints = np.where(along_y > 0.5, 1.0, -1.0)
    vector = np.array([1.0, -1.0, 1.0])
    first, second = np.random.default_rng(0).normal(size=(2, 3))
    spin = np.cross(vector * first, vector * second) / np.cross(first, second)
    signs = {
        "joint_angles": joints, "joint_velocities": joints, "ball_position": vector,
        "ball_velocity": vector, "ball_quaternion": np.concatenate([[1.0], spin]),
        "ball_angular_velocity": spin, "paddle_position": vector, "target_height": np.ones(1),
    }  # fmt: skip
    return np.concatenate([signs[part.name] for part in env.layout.parts]), joints


def test_the_pages_symmetry_is_that_of_the_arm(tmp_path):
    """The term is the difference between the actions that the policy, as it is evaluated, takes in
    a state and in its mirror image, in their units."""
    env = BounceBall()
    of_observation, of_action = signs_of_the_mirror_image(env)
    symmetric = recipe("Symmetric", tmp_path)
    settings = two_state_config(critic_metrics=("n_bounces",)).model_dump()
    free = symmetric(symmetric.Config(**settings, symmetry_cost=0.0), env, 100)
    costly = symmetric(symmetric.Config(**settings, symmetry_cost=3.0), env, 100)
    params = ppo.Params(
        policy=costly.networks.policy_network.init(jax.random.key(0)),
        value=costly.networks.value_network.init(jax.random.key(1)),
    )
    rng = np.random.default_rng(0)
    size = env.observation_size + 1
    mean, std = np.float32(rng.normal(size=size)), np.float32(rng.uniform(0.5, 2.0, size))
    raw = np.float32(mean + std * rng.uniform(-1.0, 1.0, (32, size)))
    normalizer = Normalizer(mean, std)
    action, number, bound = np.zeros((32, 6)), np.zeros(32), np.zeros((32, 1))
    inputs = normalize(raw, normalizer)
    samples = ppo.Samples(inputs, action, number, number, number, bound, normalizer)

    observation = raw[:, : env.observation_size]
    evaluated = policy.Policy(Normalizer(mean[:-1], std[:-1]), params.policy)
    here = costly.networks.act(evaluated, observation)
    there = costly.networks.act(evaluated, of_observation * observation)
    expected = np.mean(np.square(there - of_action * here))
    without, _ = free.loss(params, samples)
    total, metrics = costly.loss(params, samples)
    assert expected > 1e-6
    assert float(metrics["loss/asymmetry"]) == pytest.approx(expected, rel=1e-3)
    assert float(total - without) == pytest.approx(3.0 * expected, rel=1e-2)


def test_an_arm_has_a_mirror_image():
    """The paddle of the mirrored joint angles is the mirrored paddle, in MuJoCo."""
    env = BounceBall()
    _, of_action = signs_of_the_mirror_image(env)
    angles = np.random.default_rng(1).uniform(-1.0, 1.0, 6)
    paddles = []
    for pose in (angles, of_action * angles):
        data = mujoco.MjData(env.mj_model)
        data.qpos[list(env.addresses.arm_qpos)] = pose
        mujoco.mj_kinematics(env.mj_model, data)
        paddles.append(data.geom_xpos[env.addresses.paddle_geom].copy())
    np.testing.assert_allclose(paddles[1], paddles[0] * [1.0, -1.0, 1.0], atol=1e-9)


@pytest.mark.slow
def test_the_pages_a2c_with_the_pages_network_learns(tmp_path):
    """The reward is the negative square of a distance, at first 0.3^2."""
    a2c, normed = recipe("A2C", tmp_path), recipe("NormedCritic", tmp_path)
    kind = type("Both", (a2c, normed), {})
    config = two_state_config(
        num_envs=64, reward_scale=10.0, discount=0.0, learning_rate=1e-2, num_minibatches=1
    )
    trainer = kind(a2c.Config(**config.model_dump(exclude={"num_epochs"})), Precise(1.0), 2)
    assert trainer.config.num_epochs == 1
    state, metrics = jax.jit(lambda key: trainer.run(trainer.init(key), 400))(jax.random.key(0))
    assert state.params.value["params"]["layers_1"]["scale"].shape == (128,)
    action = trainer.networks.act(ppo.policy_of(state, 2), jnp.eye(2))
    np.testing.assert_allclose(action, 0.3, atol=0.05)
    assert metrics["reward"][-1] > metrics["reward"][0] / 4
    assert not np.any(metrics["fault"])


def test_a_shared_critic_continues_the_policys_layers(trainer):
    """Both with the chosen activation; the error of the values also trains these layers."""
    changes = {"shared_critic": True, "activation": "tanh"}
    shared = ppo.PPO(trainer.config.model_copy(update=changes), trainer.env, 100)
    params = jax.jit(shared.init)(jax.random.key(1)).params
    inputs = jnp.float32(np.random.default_rng(1).normal(size=(5, 3)))
    hidden = params.policy["params"]["MLP_0"]["hidden_0"]
    head = params.value["params"]["hidden_0"]
    features = np.tanh(inputs[:, :2] @ hidden["kernel"] + hidden["bias"])
    expected = np.concatenate([features, inputs[:, 2:]], 1) @ head["kernel"] + head["bias"]
    np.testing.assert_allclose(shared.values(params, inputs), expected[:, 0], atol=1e-5)
    mean = shared.distribution(params, inputs, jnp.zeros((5, 1))).mean
    last = params.policy["params"]["Dense_0"]
    np.testing.assert_allclose(mean, features @ last["kernel"] + last["bias"], atol=1e-5)
    gradient = jax.grad(lambda p: jnp.sum(shared.values(p, inputs)))(params)
    assert np.abs(gradient.policy["params"]["MLP_0"]["hidden_0"]["kernel"]).max() > 0


OWN = """
from bounce_mjx.learning.config import PPOConfig
from bounce_mjx.learning.ppo import PPO
class Own(PPO):
    class Config(PPOConfig):
        own_cost: float = 0.5
        "Weight."
"""


def test_settings_of_an_own_algorithm_are_keys(tmp_path):
    """A policy is read without them, and without the code."""
    (tmp_path / "own.py").write_text(OWN)
    import_code(tmp_path / "own.py")
    flags = ["--config", "cpu", "--algorithm", "own", "--own-cost", "2"]
    config = settings_of(flags, "cpu").config
    assert find_algorithm(config.algorithm)(config.ppo, BounceBall(), 100).config.own_cost == 2.0
    config = config.model_copy(update={"log_dir": tmp_path / "runs"})
    policy = jax.tree.map(lambda x: np.ones(x.shape, x.dtype), policy_shapes(config))
    run = write_run(config, 64, policy)
    assert load_run_config(run).ppo.own_cost == 2.0
    user_code._code_files.clear()
    without = load_run_config(run)
    assert not hasattr(without.ppo, "own_cost")
    jax.tree.map(
        np.testing.assert_array_equal, read_policy(latest_checkpoint(run), without), policy
    )
    with pytest.raises(UserError, match=r"the algorithm own, whose code is .+/algorithm/own.py"):
        settings_of([str(run)])
    with pytest.raises(UserError, match="there is no algorithm 'sac'; give ppo, or --import"):
        settings_of(["--algorithm", "sac"])


def test_the_first_state_needs_no_lapack(trainer):
    """With two threads, two batched calls of jaxlib's LAPACK can wait for each other forever."""
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    program = jax.jit(ppo.population(trainer)[0]).lower(keys).as_text()
    assert "lapack" not in program


@pytest.mark.parametrize("size", [2, 64])
def test_random_orders_are_uniform(size):
    keys = jax.random.split(jax.random.PRNGKey(size), 2000)
    orders = np.asarray(jax.vmap(lambda key: ppo.random_order(key, size))(keys))
    np.testing.assert_array_equal(np.sort(orders), np.tile(np.arange(size), (2000, 1)))
    # How often each index is at each place: binomial, with a limit of five standard deviations.
    counts = np.stack([np.bincount(column, minlength=size) for column in orders.T])
    expected = 2000 / size
    assert np.abs(counts - expected).max() <= 5 * np.sqrt(expected * (1 - 1 / size))
    # Neighbours are independent: the second is larger than the first in half of the orders.
    rises = np.mean(orders[:, 1:] > orders[:, :-1], axis=0)
    assert np.abs(rises - 0.5).max() <= 5 * 0.5 / np.sqrt(2000)


@pytest.mark.slow
def test_ppo_learns_to_bounce():
    env = BounceBall(EnvConfig(episode_seconds=4.0))
    config = PPOConfig(
        num_envs=128, rollout_length=32, num_minibatches=4, hidden_layers=(64, 64),
        learning_rate=1e-3,
    )  # fmt: skip
    trainer = ppo.PPO(config, env, env.config.episode_steps)
    untrained = jax.jit(trainer.init)(jax.random.key(0))
    trained, metrics = jax.jit(trainer.run, static_argnums=1)(untrained, 180)

    networks = policy.make_networks(config, env.observation_size, env.action_size)
    unseen = jax.random.key(1234)
    policies = [
        ppo.policy_of(untrained, OBSERVATION.size),
        ppo.policy_of(trained, OBSERVATION.size),
    ]
    evaluate = make_evaluator(env, networks, episodes=64).lower(policies[0], unseen)
    evaluate = evaluate.compile()
    before, after = (judge(env, *evaluate(p, unseen)).details for p in policies)
    assert after["mean_return"] > 3 * before["mean_return"]
    assert after["mean_consecutive_bounces"] > before["mean_consecutive_bounces"] + 2
    rewards = np.asarray(metrics["reward"])
    assert rewards[-20:].mean() > rewards[:20].mean()
