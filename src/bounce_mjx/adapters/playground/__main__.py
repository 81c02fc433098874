"""Playground's program `train-jax-ppo`, which knows this environment here:
`python -m bounce_mjx.adapters.playground --env_name=BounceBall`."""

import imageio_ffmpeg
import mediapy
from learning import train_jax_ppo

from bounce_mjx.adapters.brax import device_put_replicated

if __name__ == "__main__":
    # The program writes a video at its end.
    mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
    with device_put_replicated():
        train_jax_ppo.run()
