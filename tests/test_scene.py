"""What the viewers draw: shapes, markers, labels, the page's camera and its texts."""

import itertools
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

import viewing
from bounce_mjx import BounceBall, EnvConfig
from bounce_mjx.resources import resource_path
from bounce_mjx.tasks.bounce_rewards import BounceReward
from bounce_mjx.viewers.controls import direction
from bounce_mjx.viewers.display import (
    Display,
    _primitive,
    camera_pose,
    marker_body,
)
from bounce_mjx.viewers.scene import _grid as scene_grid
from viewing import NAN, at_height


@pytest.fixture(scope="module")
def env() -> BounceBall:
    return viewing.mirrored().env


SHAPES = """<mujoco><worldbody>
  <geom type="sphere" size=".1"/><geom type="capsule" size=".1 .3"/>
  <geom type="cylinder" size=".1 .3"/><geom type="box" size=".1 .3 .2"/>
  <geom type="ellipsoid" size=".1 .3 .2"/>
</worldbody></mujoco>"""


def test_shapes_have_the_sizes_of_mujoco() -> None:
    model = mujoco.MjModel.from_xml_string(SHAPES)
    for geom in range(model.ngeom):
        mesh = _primitive(model.geom_type[geom], model.geom_size[geom])
        center, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        bounds = [center - half, center + half]
        np.testing.assert_allclose(mesh.bounds, bounds, rtol=0.01, atol=1e-9)
        # The faces look outward.
        assert np.all(np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles_center) > 0.0)


def marker_position(display: Display, name: str) -> np.ndarray:
    return display.data.body(marker_body(name)).xpos


def test_markers_are_at_the_positions_of_the_task() -> None:
    config = EnvConfig(reward=BounceReward(paddle_home_height=0.15))
    display = Display(env := BounceBall(config))
    display.pose(env.mj_model.qpos0, at_height(0.61))
    x, y = config.reward.target_x, config.reward.target_y
    np.testing.assert_allclose(marker_position(display, "target_height"), (x, y, 0.61))
    np.testing.assert_allclose(marker_position(display, "paddle_home"), (x, y, 0.15))


def test_a_model_without_markers_gets_them(tmp_path: Path) -> None:
    text = resource_path("mjcf/bounce_ball.xml").read_text(encoding="utf-8")
    bare = tmp_path / "bare.xml"
    bare.write_text(re.sub(r"<site [^>]*/>", "", text), encoding="utf-8")
    env = BounceBall(EnvConfig(mjcf=bare))
    assert env.mj_model.nsite == 0
    display = Display(env)
    display.pose(env.mj_model.qpos0, at_height(0.5))
    assert marker_position(display, "target_height")[2] == 0.5
    home_height = env.config.reward.paddle_home_height
    assert marker_position(display, "paddle_home")[2] == pytest.approx(home_height)


def projected(points: np.ndarray, focus, aspect: float, offsets, zoom=1.0) -> np.ndarray:
    """Points [N, 3] in the picture [N, 2]: -1 to 1 from left to right and from below."""
    position, gaze = camera_pose(offsets, focus, aspect, zoom)
    forward = (gaze - position) / np.linalg.norm(gaze - position)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    seen = (points - position) @ np.stack([right, np.cross(right, forward), forward]).T
    return seen[:, :2] / seen[:, 2:] / np.tan(np.radians(20.0)) / (aspect, 1.0)


ASPECTS = (0.46, 0.85, 2.0)
"""Width / height of a picture."""


HOMES = ((0.58856, 0.0, 0.05), (0.67, 0.0, 0.4), (0.0, 0.55, 0.25), (-0.6, 0.0, 0.3))


@pytest.mark.parametrize("home", HOMES, ids=["default", "raised", "turned", "behind"])
def test_the_camera_sees_every_robot(home) -> None:
    """Base, paddle, and the ball at the highest target."""
    x, y, z = home
    paddle = np.array([x, y, 0.0]) * (1.0 + 0.05 / np.hypot(x, y)) + (0.0, 0.0, z)
    parts = np.array([(-0.1, 0.0, 0.0), paddle, (x, y, z + 0.8)])
    for number, aspect in itertools.product((1, 2, 4, 16), ASPECTS):
        offsets = scene_grid(number)
        points = (offsets[:, None] + parts).reshape(-1, 3)
        assert np.all(np.abs(projected(points, np.array(home), aspect, offsets)) < 1.0)


VIEWS = {
    # From the default camera, the arm's side (-x, +y) is away.
    "default": ((-1.06, 1.17, -0.42), "right", (1.17, 1.06, 0.0)),
    "from behind the arm": ((1.0, 0.0, -0.3), "left", (0.0, 1.0, 0.0)),
    "from the front": ((-1.0, 0.0, -0.3), "left", (0.0, -1.0, 0.0)),
    "from above": ((0.0, 0.0, -1.0), "away", (1.0, 0.0, 0.0)),
    "any": ((0.0, 2.0, 0.0), "back", (0.0, -1.0, 0.0)),
    "no number": ((NAN, 0.0, 0.0), "up", (0.0, 0.0, 1.0)),
}


@pytest.mark.parametrize("case", VIEWS.values(), ids=VIEWS)
def test_pushes_follow_the_camera(case) -> None:
    view, towards, expected = case
    expected = np.array(expected) / np.linalg.norm(expected)
    np.testing.assert_allclose(direction(towards, np.array(view)), expected, atol=1e-12)
