"""Sliding friction of the balls after a physics step: `physics.friction` in scalar arithmetic."""

from collections.abc import Sequence

from bounce_mjx.physics.friction import impulse_per_slip
from bounce_mjx.physics.fused import chain
from bounce_mjx.physics.fused.ball import Ball
from bounce_mjx.physics.fused.contact import Contact
from bounce_mjx.physics.fused.model import BallModel, FusedModel
from bounce_mjx.physics.scalars import Scalar, Vec, add, cross, dot, mul, not_inlined


def rub(
    model: FusedModel,
    pose: chain.Pose,
    mass_factor: chain.Factor,
    centres: Sequence[Vec],
    contacts: Sequence[Contact],
    normal_forces: Sequence[Scalar],
    v: Vec,
    balls: Sequence[Ball],
) -> tuple[Vec, tuple[Ball, ...]]:
    """Velocities of the joints, and the balls, after the impulses of friction.

    Args:
      pose: of the arm at the step's start.
      mass_factor: Cholesky factor of the arm's mass matrix there.
      centres: of the balls there, m.
      contacts: geometry of each of `FusedModel.contacts` there.
      normal_forces: of each in the step, N.
      v: velocities [n] of the joints after the step, rad/s or m/s.
      balls: after the step.
    """
    balls = list(balls)
    for pair, contact, force in zip(model.contacts, contacts, normal_forces, strict=True):
        if pair.friction is None:
            continue
        largest = mul(mul(pair.friction, model.dt), force)
        if len(pair.balls) == 1:
            (ball,) = pair.balls
            v, balls[ball] = _rub_on_paddle(
                model, pose, mass_factor, centres[ball], contact, largest, v, balls[ball], ball
            )
        else:
            first, last = pair.balls
            balls[first], balls[last] = _rub_each_other(
                model.balls[first], model.balls[last], contact, largest, balls[first], balls[last]
            )
    return v, tuple(balls)


def _rub_on_paddle(
    model: FusedModel,
    pose: chain.Pose,
    mass_factor: chain.Factor,
    centre: Vec,
    contact: Contact,
    largest: Scalar,
    v: Vec,
    ball: Ball,
    index: int,
) -> tuple[Vec, Ball]:
    """Joint velocities and a ball after the impulse between the ball and the paddle."""
    ball_model = model.balls[index]
    lever = contact.normal * -ball_model.radius
    per_joint = list(chain.point_velocities(model.links, pose, centre + lever))
    of_paddle = Vec(dot([velocity[i] for velocity in per_joint], v) for i in range(3))
    # All results need what is kept here (`not_inlined`).
    slip = not_inlined(_tangential(_surface_velocity(ball, lever) - of_paddle, contact))
    # The paddle's velocity counts against the ball's.
    generalised = [-(slip @ velocity) for velocity in per_joint]
    half_generalised = not_inlined(chain.solve_lower(mass_factor, generalised))
    squared_slip = slip @ slip
    compliance = add(
        mul(squared_slip, _surface_compliance(ball_model)),
        dot(half_generalised, half_generalised),
    )
    scale = not_inlined(impulse_per_slip(squared_slip, compliance, largest))
    v = v - Vec(chain.solve_upper(mass_factor, half_generalised)) * scale
    return v, _after_impulse(ball_model, ball, lever, slip * -scale)


def _rub_each_other(
    first_model: BallModel,
    last_model: BallModel,
    contact: Contact,
    largest: Scalar,
    first: Ball,
    last: Ball,
) -> tuple[Ball, Ball]:
    """Two balls after the impulse between them."""
    first_lever = contact.normal * first_model.radius
    last_lever = contact.normal * -last_model.radius
    relative_velocity = _surface_velocity(last, last_lever) - _surface_velocity(first, first_lever)
    slip = _tangential(relative_velocity, contact)
    squared_slip = slip @ slip
    compliance = mul(
        squared_slip, add(_surface_compliance(first_model), _surface_compliance(last_model))
    )
    impulse = slip * -impulse_per_slip(squared_slip, compliance, largest)
    return (
        _after_impulse(first_model, first, first_lever, -impulse),
        _after_impulse(last_model, last, last_lever, impulse),
    )


def _surface_velocity(ball: Ball, lever: Vec) -> Vec:
    """Velocity of a ball's surface at a lever from its centre, m/s."""
    return ball.velocity + cross(ball.turning.spin, lever)


def _tangential(vector: Vec, contact: Contact) -> Vec:
    """The part of a vector along a contact."""
    return vector - contact.normal * (contact.normal @ vector)


def _surface_compliance(ball: BallModel) -> Scalar:
    """Velocity of a free ball's surface along it per impulse along it, 1/kg."""
    return add(1.0 / ball.mass, mul(ball.radius, ball.radius) / ball.inertia)


def _after_impulse(model: BallModel, ball: Ball, lever: Vec, impulse: Vec) -> Ball:
    """A ball after an impulse (N s) at a lever from its centre (m)."""
    velocity = ball.velocity + impulse * (1.0 / model.mass)
    spin = ball.turning.spin + cross(lever, impulse) * (1.0 / model.inertia)
    return ball._replace(velocity=velocity, turning=ball.turning._replace(spin=spin))
