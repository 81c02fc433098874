"""CleanRL: the form of its ppo_continuous_action on 256 environments in one step.

`python examples/cleanrl_ppo.py` needs the extra `torch`.
"""

import argparse

import gymnasium
import torch
from torch.distributions import Normal

import bounce_mjx.adapters.gymnasium  # noqa: F401  registers the environment

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--num-envs", type=int, default=256)
parser.add_argument("--steps", type=int, default=5_000_000)
arguments = parser.parse_args()
NUM_STEPS, GAMMA, LAMBDA, CLIP, SCALE = 32, 0.98, 0.95, 0.2, 0.1
envs = gymnasium.make_vec("bounce_mjx/BounceBall-v0", arguments.num_envs, autoreset_mode="SameStep")
actor, critic = (
    torch.nn.Sequential(torch.nn.Linear(29, 128), torch.nn.ELU(), torch.nn.Linear(128, outputs))
    for outputs in (6, 1)
)
log_std = torch.nn.Parameter(torch.full((6,), -1.0))
optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters(), log_std], lr=1e-3)
shape = NUM_STEPS, arguments.num_envs
obs, actions = torch.zeros(*shape, 29), torch.zeros(*shape, 6)
logprobs, rewards, dones = torch.zeros(3, *shape)
next_obs = torch.as_tensor(envs.reset(seed=1)[0])
for iteration in range(max(1, arguments.steps // (NUM_STEPS * arguments.num_envs))):
    for t in range(NUM_STEPS):
        distribution = Normal(actor(next_obs).detach(), log_std.exp().detach())
        obs[t], actions[t] = next_obs, distribution.sample()
        logprobs[t] = distribution.log_prob(actions[t]).sum(-1)
        *given, infos = envs.step(actions[t].numpy())
        next_obs, reward, terminated, truncated = map(torch.as_tensor, given)
        rewards[t], dones[t] = SCALE * reward, terminated | truncated
        if "final_info" in infos:
            episode, over = (infos["final_info"][key] for key in ("episode", "_episode"))
            print(f"iteration={iteration}, episodic_return={episode['r'][over].mean():.1f}")
    with torch.no_grad():
        values = torch.cat([critic(obs), critic(next_obs)[None]]).squeeze(-1)
        advantages = torch.zeros(NUM_STEPS + 1, arguments.num_envs)
        for t in reversed(range(NUM_STEPS)):
            delta = rewards[t] + GAMMA * (1 - dones[t]) * values[t + 1] - values[t]
            advantages[t] = delta + GAMMA * LAMBDA * (1 - dones[t]) * advantages[t + 1]
        returns = advantages[:-1] + values[:-1]
    batch = [x.flatten(0, 1) for x in (obs, actions, logprobs, advantages[:-1], returns)]
    for _ in range(4):
        for chosen in torch.randperm(len(batch[0])).chunk(4):
            b_obs, b_actions, b_logprobs, b_advantages, b_returns = (x[chosen] for x in batch)
            new = Normal(actor(b_obs), log_std.exp()).log_prob(b_actions).sum(-1)
            ratio = (new - b_logprobs).exp()
            advantage = (b_advantages - b_advantages.mean()) / (b_advantages.std() + 1e-8)
            clipped = ratio.clamp(1 - CLIP, 1 + CLIP) * advantage
            loss = -torch.min(ratio * advantage, clipped).mean()
            loss = loss + 0.5 * (critic(b_obs).squeeze(-1) - b_returns).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
