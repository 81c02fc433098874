"""Several balls in the scene of one."""

import itertools

import mujoco

from bounce_mjx.robot.arm import raise_solver_limits
from bounce_mjx.robot.contact import PAIR_SETTINGS
from bounce_mjx.robot.names import BALL_BODY_NAME, BALL_NUMBERS, PADDLE_GEOM_NAME

MAX_BALLS = len(BALL_NUMBERS)
BALLS_APART = 0.1
"""Height of each added ball above the last one, m."""


def ball_name(index: int) -> str:
    """Name of the body of a ball, which counts from 0: ball_link, ball_link2, ball_link3."""
    return BALL_BODY_NAME + BALL_NUMBERS[index]


def add_balls(spec: mujoco.MjSpec, num_balls: int) -> None:
    """Adds balls to a scene until it has `num_balls`: copies of the first one with all that it
    consists of, such as its contact pair with the paddle, and pairs like that one between each two
    balls. A ball or a pair that the scene has stays as it is.

    MuJoCo's solver may then take its default number of iterations. With the shipped limits, a step
    with two touching balls is wrong by up to four times the largest velocity.
    """
    if num_balls == 1 or spec.body(BALL_BODY_NAME) is None:
        return
    raise_solver_limits(spec.option)
    spec.copy_during_attach = True
    for i in range(1, num_balls):
        if spec.body(ball_name(i)) is None:
            # The copy brings its pairs.
            frame = spec.worldbody.add_frame(pos=[0.0, 0.0, BALLS_APART * i])
            frame.attach_body(spec.body(BALL_BODY_NAME), prefix="", suffix=BALL_NUMBERS[i])
    pairs = {frozenset((pair.geomname1, pair.geomname2)): pair for pair in spec.pairs}
    touching = []
    for i in range(num_balls):
        for geom in spec.body(ball_name(i)).geoms:
            # The one that `find_addresses` takes; a ball without a pair touches nothing.
            if frozenset((geom.name, PADDLE_GEOM_NAME)) in pairs:
                touching.append(geom.name)
                break
    for first, second in itertools.combinations(touching, 2):
        if frozenset((first, second)) not in pairs:
            with_paddle = pairs[frozenset((second, PADDLE_GEOM_NAME))]
            settings = {name: getattr(with_paddle, name) for name in PAIR_SETTINGS}
            spec.add_pair(geomname1=first, geomname2=second, **settings)
