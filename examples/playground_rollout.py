"""MuJoCo Playground: the environment from its registry, randomised worlds and a video.

`python examples/playground_rollout.py` needs `pip install playground`. A training is
`python -m bounce_mjx.adapters.playground --env_name=BounceBall`, Playground's own program.
"""

import functools
from pathlib import Path

import imageio_ffmpeg
import jax
import jax.numpy as jnp
import mediapy
from mujoco_playground import registry, wrapper

import bounce_mjx.adapters.playground  # noqa: F401  (registers the environment)


def main(video: Path = Path("playground.mp4"), steps: int = 50, num_envs: int = 4) -> jax.Array:
    """Drops the ball in worlds of their own and films the first; the final heights [B], m."""
    env = registry.load("BounceBall", config_overrides={"task.target_height_range": [0.5, 0.5]})
    randomizer = functools.partial(
        registry.get_domain_randomizer("BounceBall"),
        rng=jax.random.split(jax.random.PRNGKey(0), num_envs),
    )
    worlds = wrapper.wrap_for_brax_training(env, randomization_fn=randomizer)
    state = jax.jit(worlds.reset)(jax.random.split(jax.random.PRNGKey(1), num_envs))
    step, states = jax.jit(worlds.step), []
    for _ in range(steps):
        state = step(state, jnp.zeros((num_envs, env.action_size)))
        states.append(jax.tree.map(lambda x: x[0], state))
    mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
    mediapy.write_video(video, env.render(states, 240, 320, camera="overview"), fps=1.0 / env.dt)
    return state.data.qpos[:, -5]


if __name__ == "__main__":
    print(main())
