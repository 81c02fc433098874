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

from bounce_mjx import Run, environment
from bounce_mjx.adapters.playground import PlaygroundTaskEnv
from bounce_mjx.viewers.video import find_ffmpeg

TARGET_HEIGHT = 0.5
"""m."""
BALL_Z = -5
"""Place of the ball's height in `qpos`, which ends with its position and its quaternion."""


def main(
    policy: str = "robust",
    video: Path = Path("playground.mp4"),
    steps: int = 300,
    num_envs: int = 4,
) -> jax.Array:
    """Bounces the ball in several worlds and films the first; the final heights [B], m."""
    task = environment(policy=policy, target_height_range=(TARGET_HEIGHT, TARGET_HEIGHT))
    env = PlaygroundTaskEnv(task)
    randomization_rng = jax.random.split(jax.random.PRNGKey(0), num_envs)
    randomization_fn = functools.partial(
        registry.get_domain_randomizer("BounceBall"), rng=randomization_rng
    )
    batched_env = wrapper.wrap_for_brax_training(env, randomization_fn=randomization_fn)
    act = Run(policy).policy_in(env)

    jit_reset = jax.jit(batched_env.reset)
    jit_step = jax.jit(batched_env.step)
    state = jit_reset(jax.random.split(jax.random.PRNGKey(1), num_envs))
    rollout = []
    for _ in range(steps):
        state = jit_step(state, act(state.obs))
        first_world = jax.tree.map(lambda x: x[0], state)
        rollout.append(first_world)

    frames = env.render(rollout, height=240, width=320, camera="overview")
    mediapy.set_ffmpeg(find_ffmpeg())
    mediapy.write_video(video, frames, fps=1.0 / env.dt)
    return state.data.qpos[:, BALL_Z]


if __name__ == "__main__":
    print(main(*sys.argv[1:2]))
