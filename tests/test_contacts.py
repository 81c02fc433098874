"""Contacts of the arm with itself and with what is around it are found in a recording."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bounce_mjx import EnvConfig
from bounce_mjx.commands.main import main
from bounce_mjx.errors import UserError
from bounce_mjx.evaluation.contacts import ContactChecker, arm_contacts
from bounce_mjx.identify.excitation import excite
from bounce_mjx.robot.model import find_addresses, load_model
from bounce_mjx.task.task import Recording

HOME = np.radians([0.0, 40.0, 110.0, 0.0, -60.0, 0.0])


def recording(joint_angles: np.ndarray, running: np.ndarray | None = None) -> Recording:
    """Episodes with the same postures [T, 6]."""
    steps = len(joint_angles)
    running = np.ones((steps, 2), bool) if running is None else running
    empty = np.zeros((steps, 3, 2))
    return Recording(
        joint_angles=np.stack([joint_angles] * 2, axis=-1),
        ball=empty,
        paddle=empty,
        goal={},
        running=running,
        terminated=np.zeros_like(running),
    )


def test_an_arm_that_folds_or_dives_touches() -> None:
    config = EnvConfig()
    for angle in (0.0, 0.3):
        turned = EnvConfig(default_joint_angles=tuple(HOME + angle))
        assert arm_contacts(turned, recording((HOME + angle)[None])) == []
    # The wrist folds until the paddle is in the forearm.
    folded = HOME + np.outer(np.linspace(0.0, 1.0, 30), [0.0, 0.0, 0.0, 0.0, -2.0, 0.0])
    (first, *_) = found = arm_contacts(config, recording(folded))
    assert first.episodes == 2 and "the floor" not in str(found)
    # The shoulder leans forward until the paddle is on the floor.
    diving = HOME + np.outer(np.linspace(0.0, 1.0, 30), [0.0, 0.8, 0.0, 0.0, 0.0, 0.0])
    found = arm_contacts(config, recording(diving))
    assert any("the floor" in contact.bodies for contact in found)
    assert all(contact.steps < 2 * 30 for contact in found)
    # An episode that has ended does not count.
    running = np.ones((30, 2), bool)
    running[:, 1] = False
    assert all(c.episodes == 1 for c in arm_contacts(config, recording(diving, running)))


def test_a_margin_is_the_distance_in_metres() -> None:
    """To the floor and between two links, as MuJoCo measures distances."""
    config, margin = EnvConfig(), 0.02
    checker = ContactChecker(config, margin, table_height=-0.02)
    model = load_model(None, 0.001)
    data, paddle = mujoco.MjData(model), find_addresses(model).paddle_geom
    last, forearm = (model.body(name).id for name in ("Link6", "Link4"))
    seen = set()
    for turn in np.linspace(-0.05, 0.1, 60):
        pose = HOME + [0.0, turn, 0.0, 0.0, -10.0 * turn, 0.0]
        data.qpos[:6] = pose
        mujoco.mj_kinematics(model, data)
        touching = {tuple(map(checker.name, pair)) for pair in checker.touching(pose)}
        links = [np.flatnonzero(model.geom_bodyid == body) for body in (forearm, last)]
        apart = min(
            mujoco.mj_geomDistance(model, data, int(a), int(b), 1.0, None)
            for a in links[0]
            for b in links[1]
        )
        if abs(apart - margin) > 1e-4:
            assert (("Link4", "Link6") in touching) == (apart < margin)
        seen.add(apart < margin)
        size, rotation = model.geom_size[paddle], data.geom_xmat[paddle].reshape(3, 3)
        lowest = data.geom_xpos[paddle][2] - np.abs(rotation[2]) @ size
        if lowest < margin - 1e-4:
            assert ("the floor", "Link6") in touching
        if lowest + 0.02 < margin - 1e-4:
            assert ("the table", "Link6") in touching
    assert seen == {True, False}


# A flat picture on the last link, which has no hull, and a link whose picture is in the way.
PICTURES = """
<mujoco><compiler angle="radian"/>
  <asset><mesh name="sticker" vertex="0 0 0 .03 0 0 0 .03 0 .03 .03 0" face="0 1 2 1 3 2"
    inertia="shell"/></asset>
  <worldbody><body pos="0 0 .3"><joint name="turn" axis="0 0 1" range="-3 3"/>
    <geom type="capsule" fromto="0 0 0 0 0 .1" size=".04"/>
    <body pos="0 0 .15"><joint name="lift" axis="0 1 0" range="-3 3"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".04"/>
      <geom type="box" size=".1 .1 .1" pos=".3 0 0" contype="0" conaffinity="0" group="2" mass="0"/>
      <body pos=".3 0 0"><joint name="bend" axis="0 1 0" range="-3 3"/>
        <geom type="capsule" fromto="0 0 0 .1 0 0" size=".03"/>
        <body name="hand" pos=".18 0 0"><joint name="roll" axis="1 0 0" range="-3 3"/>
          <geom type="sphere" size=".02"/><site name="tool" pos=".04 0 0"/>
          <geom type="mesh" mesh="sticker" contype="0" conaffinity="0" group="2" mass="0"/>
  </body></body></body></body></worldbody>
  <actuator><position joint="turn" kp="2000" kv="50"/><position joint="lift" kp="2000" kv="50"/>
    <position joint="bend" kp="2000" kv="50"/><position joint="roll" kp="2000" kv="50"/></actuator>
</mujoco>"""


def test_pictures_do_not_touch_and_what_is_in_the_way_is_named(tmp_path: Path) -> None:
    def arm(obstacle: str = "") -> EnvConfig:
        (tmp_path / "arm.xml").write_text(PICTURES.replace("<worldbody>", f"<worldbody>{obstacle}"))
        robot, start = {"site": "tool"}, (0.0, 0.0, 0.0, 0.0)
        return EnvConfig(mjcf=tmp_path / "arm.xml", robot=robot, default_joint_angles=start)

    config = arm()
    motion = excite(config, 20.0, 1.0)
    assert np.all(motion.amplitudes > 0.05)
    assert arm_contacts(config, recording(motion.targets[::10])) == []
    dive = recording(np.array([[0.0, 1.5, 0.0, 0.0]]))
    assert arm_contacts(config, dive)[0].bodies == ("hand", "the floor")
    # A wall beside the arm is in the way of its turn alone.
    wall = '<geom type="box" size=".5 .01 .5" pos="0 .072 .5"/>'
    beside = excite(arm(wall), 20.0, 1.0).amplitudes
    assert beside[0] < 0.7 * motion.amplitudes[0]
    np.testing.assert_allclose(beside[1:], motion.amplitudes[1:])
    ceiling = '<geom type="box" size=".5 .5 .01" pos="0 0 .6"/>'
    with pytest.raises(UserError, match="^the lifted arm cannot .* a contact of the base and "):
        excite(arm(ceiling), 20.0, 1.0)


@pytest.mark.slow
def test_eval_counts_them(capsys: pytest.CaptureFixture, tmp_path) -> None:
    file = tmp_path / "results.json"
    with pytest.raises(SystemExit):
        main(["eval", "pretrained", "--episodes", "4", "--contacts", "--json", str(file)])
    assert "contacts of the arm in 4 episodes: " in capsys.readouterr().out
    found = json.loads(file.read_text())["contacts"]
    assert all("the floor" in contact["bodies"] for contact in found)
