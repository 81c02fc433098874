"""Gymnasium: one environment, a policy, and your own target height.

`python examples/gymnasium_policy.py [pretrained | robust | RUN]` needs the extras `gymnasium` and
`deploy`. The environment is that of the policy's training.
"""

import argparse

import gymnasium

import bounce_mjx.adapters.gymnasium

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("policy", nargs="?", default="pretrained", help="name, file or run")
parser.add_argument("--steps", type=int, default=2000)
parser.add_argument("--target-height", type=float, default=0.5, help="m")
arguments = parser.parse_args()

env = gymnasium.make("bounce_mjx/Task-v0", policy=arguments.policy)
policy = bounce_mjx.load_policy(arguments.policy, env=env)

observation, _ = env.reset(seed=0, options={"target_height": arguments.target_height})
policy.reset()
num_bounces = 0
num_steps = 0
episode_over = False
while num_steps < arguments.steps and not episode_over:
    action = policy.step(observation)
    observation, reward, terminated, truncated, info = env.step(action)
    num_bounces += int(info["bounced"])
    num_steps += 1
    episode_over = terminated or truncated

control_dt = env.get_wrapper_attr("dt")
print(f"{num_bounces} bounces in {num_steps * control_dt:.2f} s")
