"""MuJoCo Playground: a policy in randomised worlds of its environment, filmed.

`python examples/playground_rollout.py [pretrained | robust | RUN]` needs
`pip install 'playground<1'`.
Training is `python -m bounce_mjx.adapters.playground --env_name=BounceBall`, Playground's own
program.
"""

import functools
import sys
from pathlib import Path

import jax
import mediapy
from mujoco_playground import registry, wrapper

from bounce_mjx import Run
from bounce_mjx.adapters.playground import PlaygroundBounceBall
from bounce_mjx.viewers.video import find_ffmpeg


def main(
    policy: str = "robust",
    video: Path = Path("playground.mp4"),
    steps: int = 300,
    num_envs: int = 4,
) -> jax.Array:
    """Bounces the ball in several worlds and films the first; the final heights [B], m."""
    overrides = {"task.target_height_range": [0.5, 0.5]}
    env = PlaygroundBounceBall(policy=policy, config_overrides=overrides)
    randomizer = functools.partial(
        registry.get_domain_randomizer("BounceBall"),
        rng=jax.random.split(jax.random.PRNGKey(0), num_envs),
    )
    worlds = wrapper.wrap_for_brax_training(env, randomization_fn=randomizer)
    state = jax.jit(worlds.reset)(jax.random.split(jax.random.PRNGKey(1), num_envs))
    act, step, states = Run(policy).policy_in(env), jax.jit(worlds.step), []
    for _ in range(steps):
        state = step(state, act(state.obs))
        states.append(jax.tree.map(lambda x: x[0], state))
    mediapy.set_ffmpeg(find_ffmpeg())
    mediapy.write_video(video, env.render(states, 240, 320, camera="overview"), fps=1.0 / env.dt)
    return state.data.qpos[:, -5]


if __name__ == "__main__":
    print(main(*sys.argv[1:2]))
