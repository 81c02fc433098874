"""MuJoCo's C engine with the friction of the ball: `mj_step`, and then Coulomb's impulse."""

import mujoco
import numpy as np

from bounce_mjx.errors import UserError
from bounce_mjx.physics.friction import (
    Grip,
    after_friction,
    ball_jacobian,
    grips,
    solver_model,
    unsupported_friction,
)
from bounce_mjx.robot.model import find_addresses


class CEngine:
    """Steps MuJoCo data on a model in which a ball has the friction of `physics.friction`.

    A plain `mj_step` of the same model has MuJoCo's own friction, which hardly slows a bounce.
    """

    model: mujoco.MjModel
    """The model that it steps: a copy of the given one, in which the contacts of the balls are
    frictionless for MuJoCo's solver. A change of it acts from the next step on."""

    def __init__(self, mj_model: mujoco.MjModel):
        """
        Args:
          mj_model: the model, with friction where a pair of its balls and paddle has `condim="3"`.

        Raises:
          UserError: the model has a friction of the ball that this law lacks.
        """
        self._addresses = find_addresses(mj_model)
        for name, is_present in unsupported_friction(mj_model, self._addresses):
            if is_present:
                raise UserError(f"the physics does not support {name}; change the MJCF")
        self._grips = grips(mj_model, self._addresses)
        self.model = solver_model(mj_model, self._addresses)

    @property
    def has_friction(self) -> bool:
        """Whether a contact has friction; without one, a step is `mj_step`."""
        return bool(self._grips)

    def step(self, data: mujoco.MjData, num_steps: int = 1) -> None:
        """Advances data of the model, in place, by physics steps with its present controls."""
        if not self._grips:
            mujoco.mj_step(self.model, data, nstep=num_steps)
            return
        for _ in range(num_steps):
            mujoco.mj_step(self.model, data)
            if data.ncon:
                self._rub(data)

    def _rub(self, data: mujoco.MjData) -> None:
        """Gives the impulses of friction after a step, of whose start the contacts are."""
        geoms_of_contacts = data.contact.geom.tolist()
        for grip in self._grips:
            pair = grip.pair
            geoms = [int(self.model.pair_geom1[pair]), int(self.model.pair_geom2[pair])]
            for two in (geoms, geoms[::-1]):
                if two in geoms_of_contacts:
                    self._rub_contact(data, grip, data.contact[geoms_of_contacts.index(two)])

    def _rub_contact(self, data: mujoco.MjData, grip: Grip, contact: mujoco.MjContact) -> None:
        """Gives the impulse of one contact."""
        if contact.efc_address < 0:
            return
        model = self.model
        coefficient = model.pair_friction[grip.pair, 0]
        largest = coefficient * data.efc_force[contact.efc_address] * model.opt.timestep
        last = self._addresses.balls[grip.balls[-1]]
        # MuJoCo's normal points from the first geom to the second one.
        normal = contact.frame[:3] if contact.geom[1] == last.geom else -contact.frame[:3]

        jacobian = np.zeros((3, model.nv))
        if len(grip.balls) == 1:
            # The centre at the step's start; qpos is that of its end.
            point = data.xpos[last.body] - normal * model.geom_size[last.geom, 0]
            paddle_body = model.geom_bodyid[self._addresses.paddle_geom]
            mujoco.mj_jac(model, data, jacobian, None, point, paddle_body)
            jacobian *= -1.0
        for i, side in zip(reversed(grip.balls), (1.0, -1.0), strict=False):
            ball = self._addresses.balls[i]
            lever = normal * (-side * model.geom_size[ball.geom, 0])
            of_ball = ball_jacobian(data.qpos[list(ball.qpos[3:])], lever, np)
            jacobian[:, list(ball.qvel)] += side * of_ball

        def solve(force: np.ndarray) -> np.ndarray:
            acceleration = np.empty((1, model.nv))
            mujoco.mj_solveM(model, data, acceleration, force[None])
            return acceleration[0]

        data.qvel[:] = after_friction(data.qvel, jacobian, normal, largest, solve)
