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

DISCOUNT = 0.97
TARGET_RATE = 0.1
"""Share of the critics in their targets after an update."""
MAX_EXPLORATION_STD = 0.4
TARGET_NOISE_STD = 0.2
REPLAY_STEPS = 2048
"""Steps of each environment that are kept."""
FIRST_UPDATE = 10
"""Steps of each environment before the first update."""
# A reward is up to 12 a step, and its discounted sum up to 400: 8 with this scale.
REWARD_SCALE = 0.02
MAX_RETURN = 10.0
NUM_ATOMS = 101

torch.manual_seed(arguments.seed)
env = TorchVectorEnv(
    BounceBall(), arguments.num_envs, seed=arguments.seed, reward_scale=REWARD_SCALE
)
device = env.device
num_observations = env.num_observations
num_actions = env.num_actions
# The critics see the critic metrics too.
num_inputs = num_observations + len(env.critic_metrics)
support = torch.linspace(-MAX_RETURN, MAX_RETURN, NUM_ATOMS, device=device)
normalize = nn.BatchNorm1d(num_inputs, affine=False, momentum=None, device=device)


def mlp(*widths: int) -> nn.Sequential:
    """Linear layers with ReLU between them."""
    layers = []
    for num_in, num_out in itertools.pairwise(widths):
        layers.append(nn.Linear(num_in, num_out, device=device))
        layers.append(nn.ReLU())
    return nn.Sequential(*layers[:-1])


def two_critics() -> nn.ModuleList:
    """Two networks from inputs and actions to the logits of the atoms."""
    widths = (num_inputs + num_actions, 1024, 512, 256, NUM_ATOMS)
    return nn.ModuleList([mlp(*widths), mlp(*widths)])


actor = mlp(num_observations, 512, 256, 128, num_actions)
nn.init.normal_(actor[-1].weight, 0.0, 0.01)
critics = two_critics()
target_critics = two_critics()
target_critics.load_state_dict(critics.state_dict())
actor_optimizer = torch.optim.AdamW(actor.parameters(), lr=3e-4, weight_decay=0.1)
critic_optimizer = torch.optim.AdamW(critics.parameters(), lr=3e-4, weight_decay=0.1)


def act(inputs: torch.Tensor) -> torch.Tensor:
    """The actor's actions [N, A] for normalised inputs [N, I], of which it sees the observation."""
    return torch.tanh(actor(inputs[:, :num_observations]))


@torch.no_grad()
def target_distribution(
    rewards: torch.Tensor, goes_on: torch.Tensor, next_inputs: torch.Tensor
) -> torch.Tensor:
    """Of the return [N, atoms]: that of the critic with the lower mean, shifted and put back on the
    atoms.

    Args:
      rewards: [N].
      goes_on: [N], 0 where the episode has ended.
      next_inputs: normalised [N, I].
    """
    next_actions = act(next_inputs)
    noise = (TARGET_NOISE_STD * torch.randn_like(next_actions)).clamp(-0.5, 0.5)
    next_actions = (next_actions + noise).clamp(-1.0, 1.0)
    critic_inputs = torch.cat([next_inputs, next_actions], dim=-1)
    first = target_critics[0](critic_inputs).softmax(dim=-1)
    second = target_critics[1](critic_inputs).softmax(dim=-1)
    first_is_lower = first @ support < second @ support
    lower = torch.where(first_is_lower[:, None], first, second)
    returns = rewards[:, None] + DISCOUNT * goes_on[:, None] * support
    returns = returns.clamp(-MAX_RETURN, MAX_RETURN)
    # Each return lies between two atoms, which share its probability.
    places = (returns + MAX_RETURN) / (support[1] - support[0])
    below = places.floor().clamp(0, NUM_ATOMS - 2)
    share_above = places - below
    distribution = torch.zeros_like(lower)
    distribution.scatter_add_(1, below.long(), lower * (1.0 - share_above))
    distribution.scatter_add_(1, below.long() + 1, lower * share_above)
    return distribution


def update_critics(inputs: torch.Tensor, actions: torch.Tensor, target: torch.Tensor) -> None:
    critic_inputs = torch.cat([inputs, actions], dim=-1)
    loss = torch.zeros((), device=device)
    for critic in critics:
        loss = loss + nn.functional.cross_entropy(critic(critic_inputs), target)
    descend(critic_optimizer, loss)
    with torch.no_grad():
        parameters = list(critics.parameters())
        torch._foreach_lerp_(list(target_critics.parameters()), parameters, TARGET_RATE)


def update_actor(inputs: torch.Tensor) -> None:
    critic_inputs = torch.cat([inputs, act(inputs)], dim=-1)
    first = critics[0](critic_inputs).softmax(dim=-1) @ support
    second = critics[1](critic_inputs).softmax(dim=-1) @ support
    descend(actor_optimizer, -torch.minimum(first, second).mean())


def descend(optimizer: torch.optim.Optimizer, loss: torch.Tensor) -> None:
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


class Replay:
    """The newest steps of all environments, as a ring."""

    def __init__(self):
        steps = (REPLAY_STEPS, arguments.num_envs)
        self.inputs = torch.zeros(*steps, num_inputs, device=device)
        self.actions = torch.zeros(*steps, num_actions, device=device)
        self.rewards = torch.zeros(*steps, device=device)
        self.goes_on = torch.zeros(*steps, device=device)
        self.next_inputs = torch.zeros(*steps, num_inputs, device=device)
        self.num_steps = 0

    def add(self, inputs, actions, rewards, goes_on, next_inputs) -> None:
        """Adds a step of all environments, in place of the oldest one if the ring is full."""
        place = self.num_steps % REPLAY_STEPS
        self.inputs[place] = inputs
        self.actions[place] = actions
        self.rewards[place] = rewards
        self.goes_on[place] = goes_on
        self.next_inputs[place] = next_inputs
        self.num_steps += 1

    def sample(self) -> tuple[torch.Tensor, ...]:
        """A batch of inputs, actions, rewards, goes_on, and next inputs; the inputs are
        normalised."""
        size = (arguments.batch_size,)
        step = torch.randint(min(self.num_steps, REPLAY_STEPS), size, device=device)
        member = torch.randint(arguments.num_envs, size, device=device)
        return (
            normalize(self.inputs[step, member]),
            self.actions[step, member],
            self.rewards[step, member],
            self.goes_on[step, member],
            normalize(self.next_inputs[step, member]),
        )


replay = Replay()
# Each environment explores with its own strength.
exploration_std = MAX_EXPLORATION_STD * torch.rand(arguments.num_envs, 1, device=device)
inputs = torch.cat(env.reset(), dim=-1)
for step in range(max(1, arguments.steps // arguments.num_envs)):
    # In its training mode, the normaliser takes these inputs into its running statistics.
    normalize.train()
    normalize(inputs)
    normalize.eval()
    with torch.no_grad():
        actions = act(normalize(inputs))
        actions = actions + exploration_std * torch.randn_like(actions)
        actions = actions.clamp(-1.0, 1.0)
    result = env.step(actions)
    next_inputs = torch.cat([result.final_observation, result.final_critic_metrics], dim=-1)
    # A time-out is not the end: its value continues.
    goes_on = 1.0 - result.terminated.float()
    replay.add(inputs, actions, result.reward, goes_on, next_inputs)
    inputs = torch.cat([result.observation, result.critic_metrics], dim=-1)
    if step >= FIRST_UPDATE:
        # The critics learn twice as often as the actor.
        for is_actors_turn in (False, True):
            before, taken, rewards, goes_on, after = replay.sample()
            update_critics(before, taken, target_distribution(rewards, goes_on, after))
            if is_actors_turn:
                update_actor(before)
    if step % 500 == 0:
        bounces = result.metrics[env.metric_names.index("n_bounces")]
        num_steps = (step + 1) * arguments.num_envs
        print(f"{num_steps:,} steps: {bounces:.2f} bounces in a row")
