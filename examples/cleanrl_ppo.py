"""CleanRL: the form of its ppo_continuous_action, with its names, on 256 environments in one step.

`python examples/cleanrl_ppo.py` needs the extra `torch`.
"""

import argparse

import gymnasium
import torch
from torch import nn
from torch.distributions import Normal

import bounce_mjx.adapters.gymnasium  # noqa: F401  registers the environment

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--num-envs", type=int, default=256)
parser.add_argument("--steps", type=int, default=5_000_000)
arguments = parser.parse_args()

NUM_STEPS = 32
"""Steps of each environment in a rollout."""
GAMMA = 0.98
GAE_LAMBDA = 0.95
CLIP_COEF = 0.2
VF_COEF = 0.5
UPDATE_EPOCHS = 4
NUM_MINIBATCHES = 4
LEARNING_RATE = 1e-3
# A reward is up to 12 a step, which would be large for the value network.
REWARD_SCALE = 0.1

envs = gymnasium.make_vec("bounce_mjx/BounceBall-v0", arguments.num_envs, autoreset_mode="SameStep")
(num_obs,) = envs.single_observation_space.shape
(num_actions,) = envs.single_action_space.shape


def mlp(num_outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(num_obs, 128), nn.ELU(), nn.Linear(128, num_outputs))


actor_mean = mlp(num_actions)
critic = mlp(1)
actor_logstd = nn.Parameter(torch.full((num_actions,), -1.0))
parameters = [*actor_mean.parameters(), *critic.parameters(), actor_logstd]
optimizer = torch.optim.Adam(parameters, lr=LEARNING_RATE)


def action_distribution(obs: torch.Tensor) -> Normal:
    """Of the actions [..., A] for observations [..., N]."""
    return Normal(actor_mean(obs), actor_logstd.exp())


@torch.no_grad()
def generalized_advantages(
    rewards: torch.Tensor, dones: torch.Tensor, values: torch.Tensor
) -> torch.Tensor:
    """The advantages [T, B].

    Args:
      rewards: [T, B].
      dones: [T, B], 1 where the step ended the episode.
      values: [T + 1, B], with those of the observations after the rollout.
    """
    advantages = torch.zeros_like(rewards)
    lastgaelam = torch.zeros_like(rewards[0])
    for t in reversed(range(NUM_STEPS)):
        nextnonterminal = 1.0 - dones[t]
        delta = rewards[t] + GAMMA * nextnonterminal * values[t + 1] - values[t]
        lastgaelam = delta + GAMMA * GAE_LAMBDA * nextnonterminal * lastgaelam
        advantages[t] = lastgaelam
    return advantages


def update(
    obs: torch.Tensor,
    actions: torch.Tensor,
    logprobs: torch.Tensor,
    advantages: torch.Tensor,
    returns: torch.Tensor,
) -> None:
    """A step of the optimizer on a minibatch: [M, N], [M, A], and three of [M]."""
    newlogprobs = action_distribution(obs).log_prob(actions).sum(dim=-1)
    ratio = (newlogprobs - logprobs).exp()
    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    clipped_ratio = ratio.clamp(1.0 - CLIP_COEF, 1.0 + CLIP_COEF)
    pg_loss = -torch.min(ratio * advantages, clipped_ratio * advantages).mean()
    v_loss = (critic(obs).squeeze(-1) - returns).square().mean()
    loss = pg_loss + VF_COEF * v_loss
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


# The rollout [T, B, ...].
obs = torch.zeros(NUM_STEPS, arguments.num_envs, num_obs)
actions = torch.zeros(NUM_STEPS, arguments.num_envs, num_actions)
logprobs = torch.zeros(NUM_STEPS, arguments.num_envs)
rewards = torch.zeros(NUM_STEPS, arguments.num_envs)
dones = torch.zeros(NUM_STEPS, arguments.num_envs)

first_obs, _ = envs.reset(seed=1)
next_obs = torch.as_tensor(first_obs)
num_iterations = max(1, arguments.steps // (NUM_STEPS * arguments.num_envs))
for iteration in range(num_iterations):
    for t in range(NUM_STEPS):
        obs[t] = next_obs
        with torch.no_grad():
            distribution = action_distribution(next_obs)
            actions[t] = distribution.sample()
            logprobs[t] = distribution.log_prob(actions[t]).sum(dim=-1)
        new_obs, reward, terminations, truncations, infos = envs.step(actions[t].numpy())
        next_obs = torch.as_tensor(new_obs)
        rewards[t] = REWARD_SCALE * torch.as_tensor(reward)
        # As in CleanRL, a time-out counts as an end, after which there is no value.
        dones[t] = torch.as_tensor(terminations | truncations)
        if "final_info" in infos:
            has_ended = infos["final_info"]["_episode"]
            episodic_returns = infos["final_info"]["episode"]["r"][has_ended]
            print(f"iteration={iteration}, episodic_return={episodic_returns.mean():.1f}")

    with torch.no_grad():
        values = critic(obs).squeeze(-1)
        next_value = critic(next_obs).squeeze(-1)
    advantages = generalized_advantages(rewards, dones, torch.cat([values, next_value[None]]))
    returns = advantages + values

    b_obs = obs.flatten(0, 1)
    b_actions = actions.flatten(0, 1)
    b_logprobs = logprobs.flatten(0, 1)
    b_advantages = advantages.flatten(0, 1)
    b_returns = returns.flatten(0, 1)
    for _ in range(UPDATE_EPOCHS):
        b_inds = torch.randperm(len(b_obs))
        for mb_inds in b_inds.chunk(NUM_MINIBATCHES):
            update(
                b_obs[mb_inds],
                b_actions[mb_inds],
                b_logprobs[mb_inds],
                b_advantages[mb_inds],
                b_returns[mb_inds],
            )
