"""Gymnasium: importing this package registers the environments, such as "bounce_mjx/BounceBall-v0"
and "bounce_mjx/Juggle-v0"."""

from bounce_mjx.errors import needed

with needed("Gymnasium", "bounce_mjx[gymnasium]"):
    from bounce_mjx.adapters.gymnasium.registration import register

register()
