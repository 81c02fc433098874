"""What a fit says in words: whether it explains a log, what is surprising, and what stays open."""

from collections.abc import Sequence

import numpy as np

from bounce_mjx.identify.estimates import (
    HALF_WIDTH,
    estimates,
    is_chosen,
    is_seen_by,
)
from bounce_mjx.identify.identification import Identified
from bounce_mjx.identify.unknowns import MOTIONS

# Information in units of the prior's below which a combination of unknowns is not shown.
_WEAK = 1.5
_SHARE = 0.35
# An error in windows that the search had not seen is explained up to this multiple of the sensor's
# noise, or up to these: a share of a joint's motion and an angle, rad; a distance of the ball, m.
_GOOD_FIT = 2.0
_GOOD_SHARE = 0.02
_GOOD_ANGLE = 1e-3
_GOOD_DISTANCE = 3e-3
# Share of the world's error of a joint below which another hypothesis explains it better.
_MUCH_BETTER = 0.7
# Share of the windows with a ball from which its bounces count.
_MOST_FLY = 0.5
# Height by which the ball touches the paddle beside the model's beyond which it is named: half of a
# ball's radius, m.
_HEIGHT_OFF = 0.01
# Deviations of the prior beyond which an estimate is a mistake, and what is likely to be wrong.
_SURPRISING = 3.0
# Distance from a limit of the search within which an estimate is at it, in the same deviations.
_AT_LIMIT = 1e-6
_MISTAKES = (
    "Look at the frame of the ball's position (the robot's base, in metres, z up), the unit and "
    "clock of ball_time and of the servo targets, swapped columns, a joint's zero, --robot, and "
    "how the paddle is mounted, which the log cannot tell from these: paddle_offset has its prior."
)
_ARM_MISTAKES = (
    "The servos of --robot may be made up, or it is another robot; look at the unit and clock of "
    "the servo targets too."
)


def sentences(found: Identified, joint_names: Sequence[str]) -> list[str]:
    """Sentences about the fit and about what the log cannot show."""
    said = describe_doubts(found, joint_names)
    said += _describe_arm(found)
    if found.simulated.leaves_at_once:
        said.append(
            "The ball leaves the paddle at once, as a real one does; in the world it stays for the "
            "model's contact, and leaves as fast."
        )
    if abs(found.touch_height) > _HEIGHT_OFF:
        side = "above" if found.touch_height > 0.0 else "below"
        said.append(
            f"warning: in the log, the ball touches the paddle {1e3 * abs(found.touch_height):.0f} "
            f"mm {side} the model's; look at the height of the ball's frame, at the paddle's "
            "thickness and mounting, and at the joints' zeros, among which ball_position_bias, "
            "paddle_offset and encoder_bias share it."
        )
    if found.dropped and found.dropped <= _MOST_FLY * np.sum(found.windows.has_ball):
        said.append(
            f"In {found.dropped} of {int(np.sum(found.windows.has_ball))} windows, the ball was "
            "not in free flight; their pictures do not count."
        )
    if "ball_position" in found.after and "ball_position" not in found.held_out:
        said.append(
            "No window with a bounce was left out of the search, so that nothing checks what was "
            "found about the ball; record more bounces."
        )
    if not np.any(found.windows.has_ball):
        said.append(
            "The log shows fewer than three bounces, so only the arm was identified, without a "
            "zero that an encoder and its servo share (encoder_bias)."
        )
    delay = found.layout.slices["delay"].start
    lag = found.layout.slices["delay_variance"].start
    is_seen = is_seen_by(found)
    if is_seen[delay] and not is_seen[lag]:
        said.append(
            "The log does not tell action_latency and servo_lag apart; their sum is what it shows."
        )
    return [*_describe_mistakes(found, joint_names), *said, *_describe_unseen(found, joint_names)]


def _describe_arm(found: Identified) -> list[str]:
    """What explains the arm, and what the world is."""
    if found.is_still:
        return [
            "No command in the log changes, so it shows neither a delay nor servos; record motions "
            "of the arm too (bounce-mjx excite)."
        ]
    name = found.choice.chosen.name
    if found.is_follower:
        why = (
            "The targets are the controller's own set points, which the joints follow at once"
            if found.has_set_points
            else f"In windows that no fit had seen, {name} explains the angles no worse than servos"
        )
        return [
            f"{why}: the world has a delay, a constant offset of each joint, and the least stiff "
            "servos that follow as exactly, of an arm whose weight is carried; these are chosen, "
            "and not measured."
        ]
    if found.choice.chosen.gravity_compensation:
        return ["The log shows that the controller carries the arm's weight."]
    return []


def describe_doubts(found: Identified, joint_names: Sequence[str]) -> list[str]:
    """Why the identified world does not explain the log, a sentence each; none if it does.

    The errors are those in windows that the search had not seen. A model that is off by less than
    its sensor's noise, or by a small share of the motion, is as good as a policy needs it.
    """
    windows = found.windows
    doubts = []
    angles = windows.angles[windows.angle_weights > 0.0]
    for j, (name, error) in enumerate(zip(joint_names, found.joint_errors, strict=False)):
        noise = found.noise.angles[j]
        motion = float(np.std(angles[:, j]))
        # Also an error that is no number is none that the model explains.
        if not error <= max(_GOOD_FIT * noise, _GOOD_SHARE * motion, _GOOD_ANGLE):
            doubts.append(
                f"The model does not explain the angles of {name}: its error in windows that the "
                f"search had not seen is {1e3 * error:.2g} mrad, and {1e3 * noise:.2g} mrad is the "
                "encoder's noise. The robot does something that the model lacks, or it is another "
                "robot."
            )
    doubts += _describe_better(found, joint_names)
    bounces = int(np.sum(windows.has_ball))
    if bounces and found.dropped > _MOST_FLY * bounces:
        doubts.append(
            f"In {found.dropped} of {bounces} windows, the ball was not in free flight as the "
            "model knows it; the other windows are too few to believe."
        )
    ratio = found.held_out.get("ball_position", 0.0)
    error = ratio * float(np.mean(found.noise.balls)) if bounces else 0.0
    if not (ratio <= _GOOD_FIT or error <= _GOOD_DISTANCE):
        doubts.append(
            f"The model does not explain the ball: its error in windows that the search had not "
            f"seen is {1e3 * error:.2g} mm, {ratio:.2g} times the camera's noise."
        )
    return doubts


def _describe_better(found: Identified, joint_names: Sequence[str]) -> list[str]:
    """Why no world is right for an arm that something explains better which no training
    simulates."""
    better = found.choice.better
    if better is None or len(found.joint_errors) != len(better.errors):
        return []
    bound = np.maximum(_GOOD_FIT * found.noise.angles, _GOOD_ANGLE)
    worse = found.joint_errors > np.maximum(bound, better.errors / _MUCH_BETTER)
    if not np.any(worse):
        return []
    joints = ", ".join(np.array(joint_names)[worse])
    of_world, of_better = (
        ", ".join(f"{1e3 * x:.2g}" for x in errors[worse])
        for errors in (found.joint_errors, better.errors)
    )
    detail = f" ({better.detail})" if better.detail else ""
    return [
        f"A {better.hypothesis.name.removeprefix('a ')}{detail} explains {joints} much better, to "
        f"{of_better} mrad for {of_world}: the controller leads or scales its commands, which no "
        "training simulates."
    ]


def _describe_mistakes(found: Identified, joint_names: Sequence[str]) -> list[str]:
    """Warnings of estimates that are several deviations of the prior away, or that cannot be."""
    layout = found.layout
    vector = found.fit.vector
    listed = estimates(found, joint_names)
    expected = layout.world(layout.mean)
    typical = np.concatenate([np.ravel(expected[name]) for name in layout.terms])
    # From what the prior expects beside the other unknowns: a gain, beside those of other joints.
    from_mean = (vector - layout.mean) / layout.deviation
    off = np.abs(layout.precision @ from_mean) / np.sqrt(np.diag(layout.precision))
    # Of a physical quantity that may be absent, such as drag, 0 is a value like any other.
    is_near = np.abs(layout.limits - vector) < _AT_LIMIT * layout.deviation
    at_limit = np.any(is_near & (layout.limits != 0.0), axis=0)
    # The deviations are those of the delay, which latency and lag share.
    delay = layout.slices["delay"].start
    listed[delay] = listed[delay]._replace(
        label="action_latency and servo_lag together", value=float(vector[delay])
    )
    typical[delay] = layout.mean[delay]
    late = layout.slices.get("ball_latency", slice(0, 0))
    typical[late] += found.stamp_age
    is_judged = ~is_chosen(found)
    said = [
        f"warning: {entry.label} is {entry.value:.4g} {entry.unit}".rstrip()
        + f", {off[i]:.1f} deviations of the prior from {typical[i]:.3g}."
        for i, entry in enumerate(listed)
        if is_judged[i] and (off[i] > _SURPRISING or at_limit[i])
    ]
    ages = vector[late] + found.stamp_age
    if np.any(ages + HALF_WIDTH * found.deviation[late] < 0.0):
        said.append(
            f"warning: the pictures arrive {-1e3 * ages[0]:.1f} ms before what they show, which "
            "cannot be; the world has a ball_latency of 0."
        )
    advice = _MISTAKES if np.any(found.windows.has_ball) else _ARM_MISTAKES
    return [*said, advice] if said else []


def _describe_unseen(found: Identified, joint_names: Sequence[str]) -> list[str]:
    """Combinations of unknowns that the log cannot show: the eigenvectors of its information, in
    units of the prior, with small eigenvalues; not of those that were chosen."""
    layout = found.layout
    searched = np.flatnonzero(~is_chosen(found))
    labels = np.array(layout.labels(joint_names))[searched]
    owners = [n for n, place in layout.terms.items() for _ in range(place.start, place.stop)]
    owners = np.array(owners)[searched]
    scaled = found.certainty.information * np.outer(layout.deviation, layout.deviation)
    values, vectors = np.linalg.eigh(scaled[np.ix_(searched, searched)])
    said: dict[frozenset[str], str] = {}
    for value, vector in zip(values, vectors.T, strict=True):
        main = np.flatnonzero(np.abs(vector) > _SHARE)
        names = frozenset(owners[i] for i in main)
        if value > _WEAK or not names or names in said:
            continue
        motion = next(x for x, shown in MOTIONS.items() if names & set(shown.split()))
        text = f"The log does not show {labels[main[0]]}: its interval is the prior's"
        if len(main) > 1:
            listed = ", ".join(labels[i] for i in main)
            text = f"The log does not separate {listed}: their intervals are mostly the prior's"
        said[names] = f"{text}; {motion} would."
    return list(said.values())
