"""The ball's position from two cameras, for any policy that needs `ball_position`.

    python examples/two_cameras.py calibrate cameras.json --sources 0 1   # with the arm
    python examples/two_cameras.py check cameras.json                     # before play
    python examples/two_cameras.py watch cameras.json                     # prints the place

docs/cameras.md says which cameras to take, and where to put them (`pip install ".[vision]"`).
"""

import argparse
from pathlib import Path

from bounce_mjx import load_policy
from bounce_mjx.errors import exit_on_user_error
from bounce_mjx.vision.camera import rough_camera
from bounce_mjx.vision.capture import Capture, device_names
from bounce_mjx.vision.circles import COLOURS
from bounce_mjx.vision.procedures import calibrate_by_hand, check_by_hand
from bounce_mjx.vision.rig import load_rig
from bounce_mjx.vision.tracker import Tracker


def watch(capture: Capture, tracker: Tracker) -> None:
    """Prints the ball's place for each pair of pictures."""
    print("learning the background: keep the ball out of the pictures")
    tracker.learn_background([capture.read()[0] for _ in range(20)])
    while True:
        pictures, taken = capture.read()
        fix = tracker.update(pictures, taken)
        if fix is not None:
            x, y, z = fix.position
            print(f"{fix.time:.4f} s: x {x:.4f}, y {y:.4f}, z {z:.4f} m, {fix.error:.2f} pixels")


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("program", choices=["calibrate", "check", "watch"])
    parser.add_argument("cameras", type=Path, help="JSON file of the calibrated cameras")
    parser.add_argument("--policy", default="robust", help="for the arm: name, file or run")
    parser.add_argument("--ball", choices=list(COLOURS), default="orange")
    parser.add_argument("--rate", type=float, default=120.0, help="Hz")
    parser.add_argument("--exposure", type=float, default=0.004, help="s")
    parser.add_argument("--transport", type=float, default=0.004, help="s")
    place = {"nargs": 3, "type": float, "metavar": ("X", "Y", "Z")}
    tape = parser.add_argument_group("for calibrate, by tape")
    tape.add_argument("--sources", nargs=2, default=["0", "1"], help="numbers or addresses")
    tape.add_argument("--first", **place, default=(1.45, 0.85, 0.75), help="m")
    tape.add_argument("--second", **place, default=(1.45, -0.85, 0.75), help="m")
    tape.add_argument("--gaze", **place, default=(0.59, 0.0, 0.48), help="where both look, m")
    tape.add_argument("--size", nargs=2, type=int, default=(640, 480), help="pixels")
    tape.add_argument("--field-of-view", type=float, default=60.0, help="horizontal, degrees")
    return parser.parse_args()


def main() -> None:
    given = parse_arguments()
    colour = COLOURS[given.ball]
    timing = (given.rate, given.exposure, given.transport)
    if given.program == "calibrate":
        size = tuple(given.size)
        capture = Capture(device_names(given.sources), size, *timing)
        places = (given.first, given.second)
        metadata = load_policy(given.policy).metadata
        rough = [rough_camera(place, given.gaze, size, given.field_of_view) for place in places]
        print(calibrate_by_hand(metadata, capture, rough, colour, given.cameras))
        return
    rig = load_rig(given.cameras)
    capture = Capture(rig.devices, rig.size, *timing)
    if given.program == "check":
        metadata = load_policy(given.policy).metadata
        print(check_by_hand(metadata, capture, rig, colour))
    else:
        watch(capture, Tracker(rig.cameras, colour, given.exposure))


if __name__ == "__main__":
    with exit_on_user_error():
        main()
