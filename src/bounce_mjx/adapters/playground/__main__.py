"""Playground's program `train-jax-ppo`, which knows this environment here:
`python -m bounce_mjx.adapters.playground --env_name=BounceBall`."""

from bounce_mjx.adapters.brax import device_put_replicated
from bounce_mjx.errors import exit_on_user_error, needed
from bounce_mjx.viewers.video import find_ffmpeg

with exit_on_user_error(), needed("MuJoCo Playground's train-jax-ppo", "playground<1"):
    import mediapy
    from learning import train_jax_ppo

if __name__ == "__main__":
    # The program writes a video at its end.
    with exit_on_user_error():
        mediapy.set_ffmpeg(find_ffmpeg())
    with device_put_replicated():
        train_jax_ppo.run()
