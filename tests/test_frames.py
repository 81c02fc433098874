"""What the viewers draw, from frames and models alone: shapes, frames at another rate, bars."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from viser.infra import StateSerializer

from bounce_mjx import BounceBall
from bounce_mjx.env.env import State
from bounce_mjx.task import term_names
from bounce_mjx.task.bounce_rewards import Rewards
from bounce_mjx.viewers.browser import reward_bars
from bounce_mjx.viewers.display import TRAIL_SECONDS, Display, Trail, body_scenes
from bounce_mjx.viewers.page import replay
from bounce_mjx.viewers.scene import ANNOUNCED_SECONDS, Scene
from bounce_mjx.viewers.simulation import (
    EnvFrame,
    frame_at,
    make_random_controller,
    resample,
)
from viewing import watch


def ramp(over: tuple[int, ...] = ()) -> EnvFrame:
    """Eleven frames of one environment, 0.01 s apart; every value is the frame's time in steps."""
    value = np.arange(11.0)[:, None]
    wide = np.repeat(value[..., None], 3, axis=-1)
    ended = np.zeros((11, 1), bool)
    ended[list(over)] = True
    goal, metrics = {"height": value}, {"count": value}
    return EnvFrame(value * 0.01, wide, wide[:, :, None], wide, goal, metrics, ended, ended)


def test_resampling_interpolates_positions() -> None:
    """Up to the recording's last frame."""
    frames = resample(ramp(), dt=0.01, fps=60)
    times = np.arange(7) / 60
    np.testing.assert_allclose(frames.time[:, 0], times)
    for positions in (frames.qpos, frames.balls[:, 0], frames.paddle):
        np.testing.assert_allclose(positions[:, 0, 0], 100 * times)
    # Goals and metrics come from the last step.
    for values in (frames.goal["height"], frames.metrics["count"]):
        np.testing.assert_array_equal(values[:, 0], np.floor(100 * times + 1e-9))


def test_resampling_does_not_blend_two_episodes() -> None:
    frames = resample(ramp(over=(3,)), dt=0.01, fps=60)
    expected = 100 * np.arange(7) / 60
    expected[2] = 3.0  # at 3.33 steps
    np.testing.assert_allclose(frames.balls[:, 0, 0, 0], expected)


def test_the_end_of_every_episode_is_in_a_frame() -> None:
    """Also where it falls between two pictures, and after the last one."""
    frames = resample(ramp(over=(4, 10)), dt=0.01, fps=30)
    assert frames.over[:, 0].tolist() == frames.lost[:, 0].tolist() == [False, False, True, True]
    # An episode that ended on its first or second step has its first and its last frame.
    for steps in (1, 2):
        short = jax.tree.map(lambda values, steps=steps: values[:steps], ramp(over=(steps - 1,)))
        frames = resample(short, dt=0.01, fps=30)
        np.testing.assert_array_equal(frames.balls, short.balls)
        assert frames.lost[-1].all()
    # 3 pictures at 12 Hz are 10 steps of 25 ms, but for the rounding.
    frames = resample(ramp(over=(10,)), dt=0.025, fps=12)
    assert len(frames.time) == 4 and frames.lost[-1].all()


def test_the_path_of_a_ball_has_each_of_its_positions_once() -> None:
    """Of its episode, also where a frame is shown again, as in a pause."""
    frames = ramp()
    trail = Trail(0.2)
    for i in (0, 1, 2, 2, 2, 2):
        trail.add(jax.tree.map(lambda values, i=i: values[i], frames))
    assert trail.points[:, 0, 0, 0].tolist() == [0.0, 1.0, 2.0]
    # Two resets in a pause begin two paths, each at another place.
    for place in (5.0, 6.0):
        start = jax.tree.map(lambda values: values[0], frames)
        trail.add(start._replace(balls=start.balls + place))
        assert trail.points[:, 0, 0, 0].tolist() == [place] * 3


def test_a_replay_shows_the_path_and_the_loss_for_as_long_as_the_live_page(
    env: BounceBall, monkeypatch
) -> None:
    """At any rate of frames."""
    lost = ramp(over=(10,))
    lost = lost._replace(
        qpos=np.tile(env.mj_model.qpos0, (11, 1, 1)),
        goal={"target_height": np.full((11, 1), 0.5)},
        metrics={"n_bounces": np.zeros((11, 1))},
    )
    scenes, seconds = [], []
    watch(monkeypatch, Scene, "update", lambda scene, frames: scenes.append(scene))
    watch(monkeypatch, StateSerializer, "insert_sleep", lambda _, time: seconds.append(time))
    for fps in (1, 30, 200):
        scenes.clear()
        seconds.clear()
        replay(env, lost, fps)
        scene = scenes[-1]
        assert scene._trail.length == max(1, round(TRAIL_SECONDS * fps))
        assert scene._labels[0].text == "LOST"
        np.testing.assert_allclose(sum(seconds), len(scenes) / fps + ANNOUNCED_SECONDS)
    # A reset after the next episode has begun is no loss.
    begun = frame_at(lost, 0)
    scene.update([begun._replace(time=np.array([2.0 * ANNOUNCED_SECONDS]))])
    scene.update([begun._replace(time=np.array([0.0]))])
    assert scene._labels[0].text != "LOST"


SHAPES = """<mujoco><worldbody>
  <body><geom type="sphere" size=".1"/></body>
  <body><geom type="capsule" size=".1 .3"/></body>
  <body><geom type="cylinder" size=".1 .3"/></body>
  <body><geom type="box" size=".1 .3 .2"/></body>
  <body><geom type="ellipsoid" size=".1 .3 .2"/></body>
</worldbody></mujoco>"""


def test_shapes_have_the_sizes_of_mujoco() -> None:
    model = mujoco.MjModel.from_xml_string(SHAPES)
    scenes = [scene for _, scene in body_scenes(model)]
    assert len(scenes) == model.ngeom == 5
    for box, scene in zip(model.geom_aabb, scenes, strict=True):
        (mesh,) = scene.geometry.values()
        center, half = box[:3], box[3:]
        np.testing.assert_allclose(mesh.bounds, [center - half, center + half], rtol=0.01)
        # The faces look outward.
        assert np.all(np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles_center) > 0.0)


def test_every_shown_geom_is_in_the_meshes(env: BounceBall) -> None:
    model = Display(env).model
    shapes = {model.body(body).name: len(s.geometry) for body, s in body_scenes(model)}
    shown = {model.body(body).name: int(model.body_geomnum[body]) for body in range(model.nbody)}
    shown["world"] -= 1  # the floor
    assert shapes == shown


def test_random_actions_are_uniform(env: BounceBall) -> None:
    states = State((), jnp.zeros((29, 500)), jnp.zeros(500), jnp.zeros(500))
    control = make_random_controller(env)
    actions = control(None, states, jax.random.PRNGKey(1))
    assert actions.shape == (env.action_size, 500)
    quartiles = np.quantile(actions, (0.0, 0.25, 0.75, 1.0))
    np.testing.assert_allclose(quartiles, (-1, -0.5, 0.5, 1), atol=0.05)
    assert np.all(control(None, states, jax.random.PRNGKey(2)) != actions)


def test_reward_bars_show_every_term() -> None:
    terms = dict.fromkeys(term_names(Rewards), 0.0) | {"position": 2.0, "alignment": -1.25}
    terms["my_term"] = 0.5
    text = reward_bars(terms)
    for name in terms:
        assert text.count(f">{name.replace('_', ' ')}<") == 1
    assert ">2.00<" in text and ">-1.25<" in text and "sum 1.25" in text
    assert "-0.00" not in reward_bars({"a": -0.001})
    assert ">&lt;i&gt;<" in reward_bars({"<i>": 1.0})
