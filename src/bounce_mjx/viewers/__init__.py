"""Ways to see the environment: a web page, MuJoCo's own viewer, a video, a replay page."""
