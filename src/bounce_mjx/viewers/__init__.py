"""Viewers: a live web page, MuJoCo's own window, a video and an offline replay page."""
