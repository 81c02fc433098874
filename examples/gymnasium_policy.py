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
parser.add_argument("--target-height", type=float, default=0.5)
arguments = parser.parse_args()

env = gymnasium.make("bounce_mjx/Task-v0", policy=arguments.policy)
policy = bounce_mjx.load_policy(arguments.policy, env=env)

observation, _ = env.reset(seed=0, options={"target_height": arguments.target_height})
policy.reset()
bounces, steps, over = 0, 0, False
while steps < arguments.steps and not over:
    observation, reward, terminated, truncated, info = env.step(policy.step(observation))
    bounces, steps, over = bounces + int(info["bounced"]), steps + 1, terminated or truncated
print(f"{bounces} bounces in {steps * env.get_wrapper_attr('dt'):.2f} s")
