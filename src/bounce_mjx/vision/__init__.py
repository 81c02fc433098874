"""The ball's place from two cameras: the measurement `ball_position` of a policy.

A place is believed only where everything agrees: the circle in each picture with the size of a ball
there (`circles`), the rays of both cameras (`camera`), and the flight since the last place
(`tracker`). The arm itself is the measure: `calibration` finds both cameras from a ball on its
paddle, and `check` compares them with it again before play. `rig` is what is known of the two, with
the names of their devices; `capture` takes their newest pictures, with the time of each;
`procedures` leads a person through both. `rendering` and `simulated` see a simulated arm.
"""

from bounce_mjx.errors import needed

with needed("OpenCV", "bounce_mjx[vision]"):
    import cv2  # noqa: F401
