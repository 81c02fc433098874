"""FastTD3 (Seo et al., arXiv 2505.22642) in one file: TD3 with many environments, large batches and
critics that predict a distribution of the return (C51, Bellemare et al. 2017).

`python examples/fasttd3.py` needs the extra `torch`, and a GPU to be fast. The authors' own code
runs on this environment in `benchmarks/fast_td3_trainer.py`.
"""

import argparse
import itertools

import torch
from torch import nn

from bounce_mjx import BounceBall
from bounce_mjx.adapters.torch import TorchVectorEnv

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--num-envs", type=int, default=1024)
parser.add_argument("--steps", type=int, default=20_000_000, help="of all environments together")
parser.add_argument("--batch-size", type=int, default=32_768)
parser.add_argument("--seed", type=int, default=0)
arguments = parser.parse_args()
GAMMA, TAU, MAX_STD, TARGET_STD, REPLAY, LEARNING_STARTS = 0.97, 0.1, 0.4, 0.2, 2048, 10
# A reward is up to 12 a step, and its discounted sum up to 400: 8 with this scale.
SCALE, MAX_VALUE, ATOMS = 0.02, 10.0, 101

torch.manual_seed(arguments.seed)
env = TorchVectorEnv(BounceBall(), arguments.num_envs, seed=arguments.seed, reward_scale=SCALE)
seen, num_actions = env.num_observations, env.num_actions
# The critics see the critic metrics too.
num_inputs = seen + len(env.critic_metrics)
device = env.device
support = torch.linspace(-MAX_VALUE, MAX_VALUE, ATOMS, device=device)
normalize = nn.BatchNorm1d(num_inputs, affine=False, momentum=None, device=device)


def mlp(*widths: int) -> nn.Sequential:
    linears = [nn.Linear(*ends, device=device) for ends in itertools.pairwise(widths)]
    layers = [layer for linear in linears for layer in (linear, nn.ReLU())]
    return nn.Sequential(*layers[:-1])


actor = mlp(seen, 512, 256, 128, num_actions)
nn.init.normal_(actor[-1].weight, 0.0, 0.01)
critics, targets = (
    nn.ModuleList(mlp(num_inputs + num_actions, 1024, 512, 256, ATOMS) for _ in range(2))
    for _ in range(2)
)
targets.load_state_dict(critics.state_dict())
actor_optimizer = torch.optim.AdamW(actor.parameters(), lr=3e-4, weight_decay=0.1)
critic_optimizer = torch.optim.AdamW(critics.parameters(), lr=3e-4, weight_decay=0.1)


def act(inputs: torch.Tensor) -> torch.Tensor:
    return torch.tanh(actor(inputs[:, :seen]))


@torch.no_grad()
def target_distribution(rewards: torch.Tensor, goes_on: torch.Tensor, after: torch.Tensor):
    """Of the return: that of the critic with the lower mean, shifted and put back on the atoms."""
    actions = act(after)
    noise = (TARGET_STD * torch.randn_like(actions)).clamp(-0.5, 0.5)
    inputs = torch.cat([after, (actions + noise).clamp(-1.0, 1.0)], -1)
    first, second = (target(inputs).softmax(-1) for target in targets)
    lower = torch.where((first @ support < second @ support)[:, None], first, second)
    values = rewards[:, None] + GAMMA * goes_on[:, None] * support
    places = (values.clamp(-MAX_VALUE, MAX_VALUE) + MAX_VALUE) / (support[1] - support[0])
    below = places.floor().clamp(0, ATOMS - 2)
    share = places - below
    distribution = torch.zeros_like(lower).scatter_add_(1, below.long(), lower * (1.0 - share))
    return distribution.scatter_add_(1, below.long() + 1, lower * share)


def update(stored_steps: int, is_actors_turn: bool) -> None:
    chosen = torch.randint(stored_steps, (arguments.batch_size,), device=device)
    which = torch.randint(arguments.num_envs, (arguments.batch_size,), device=device)
    before, actions, *outcome, after = (stored[chosen, which] for stored in replay)
    before, target = normalize(before), target_distribution(*outcome, normalize(after))
    inputs = torch.cat([before, actions], -1)
    descend(critic_optimizer, sum(nn.functional.cross_entropy(c(inputs), target) for c in critics))
    if is_actors_turn:
        inputs = torch.cat([before, act(before)], -1)
        first, second = (critic(inputs).softmax(-1) @ support for critic in critics)
        descend(actor_optimizer, -torch.minimum(first, second).mean())
    with torch.no_grad():
        torch._foreach_lerp_(list(targets.parameters()), list(critics.parameters()), TAU)


def descend(optimizer: torch.optim.Optimizer, loss: torch.Tensor) -> None:
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


shape = REPLAY, arguments.num_envs
sizes = (num_inputs,), (num_actions,), (), (), (num_inputs,)
replay = [torch.zeros(*shape, *size, device=device) for size in sizes]
# Each environment explores with its own strength.
std = MAX_STD * torch.rand(arguments.num_envs, 1, device=device)
inputs = torch.cat(env.reset(), -1)
for step in range(max(1, arguments.steps // arguments.num_envs)):
    normalize.train()(inputs)
    normalize.eval()
    with torch.no_grad():
        actions = act(normalize(inputs))
        actions = (actions + std * torch.randn_like(actions)).clamp(-1.0, 1.0)
    result = env.step(actions)
    after = torch.cat([result.final_observation, result.final_critic_metrics], -1)
    # A time-out is not the end: its value continues.
    entry = inputs, actions, result.reward, 1.0 - result.terminated.float(), after
    for stored, new in zip(replay, entry, strict=True):
        stored[step % REPLAY] = new
    inputs = torch.cat([result.observation, result.critic_metrics], -1)
    if step >= LEARNING_STARTS:
        update(min(step + 1, REPLAY), is_actors_turn=False)
        update(min(step + 1, REPLAY), is_actors_turn=True)
    if step % 500 == 0:
        bounces = result.metrics[env.metric_names.index("n_bounces")]
        print(f"{(step + 1) * arguments.num_envs:,} steps: {bounces:.2f} bounces in a row")
