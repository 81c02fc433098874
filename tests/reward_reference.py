"""The fifteen reward terms of the original specification in float64 NumPy, formula by formula.

It is independent of the package on purpose: every constant is written as in the specification.
"""

import numpy as np

REFERENCE_WEIGHTS = {
    "position": 2.0,
    "out_of_position": 1.0,
    "velocity_matching": 2.0,
    "height": 4.5,
    "height_progress": 1.0,
    "controlled_upward": 1.5,
    "consecutive_bounces": 0.8,
    "high_bounce_count": 0.3,
    "alignment": 0.6,
    "paddle_home": 1.5,
    "excessive_upward": 1.0,
    "downward_velocity": 1.0,
    "paddle_height_violation": 1.0,
    "action_rate": 1e-4,
    "joint_velocity": 1e-4,
}


def reference_terms(
    ball_position: np.ndarray,
    ball_velocity: np.ndarray,
    paddle_position: np.ndarray,
    target_height: np.ndarray,
    n_bounces: np.ndarray,
    bounced: np.ndarray,
    action: np.ndarray,
    last_action: np.ndarray,
    joint_velocity: np.ndarray,
) -> dict[str, np.ndarray]:
    """Return each unweighted term `[N]` of N states.

    `ball_position`, `ball_velocity` and `paddle_position` are `[N, 3]`; `target_height`,
    `n_bounces` and `bounced` are `[N]`; `action`, `last_action` and `joint_velocity` are `[N, 6]`.
    """
    x_ball, y_ball, z_ball = np.asarray(ball_position, np.float64).T
    v_z = np.asarray(ball_velocity, np.float64)[:, 2]
    x_paddle, y_paddle, z_paddle = np.asarray(paddle_position, np.float64).T
    h_target = np.asarray(target_height, np.float64)
    n_bounces = np.asarray(n_bounces, np.float64)
    a_t = np.asarray(action, np.float64)
    a_previous = np.asarray(last_action, np.float64)
    q_dot = np.asarray(joint_velocity, np.float64)
    exp, sqrt, log, maximum = np.exp, np.sqrt, np.log, np.maximum
    g = 9.81

    # 1. Horizontal position
    x_target, y_target = 0.58856, 0.0
    err_xy = sqrt((x_ball - x_target) ** 2 + (y_ball - y_target) ** 2)
    d_vert = np.abs(z_ball - z_paddle)
    w_vert = exp(-d_vert / 0.15)
    sigma_pos = 0.1 * (1.0 + 3.0 * w_vert)
    r_pos = exp(-(err_xy**2) / (2 * sigma_pos**2))

    # 2. Out of position
    r_out = -2.0 / (1 + exp(-(err_xy - 0.05) / 0.03))

    # 3. Velocity matching. The velocity of a case is 0 where the case does not hold. The
    # specification leaves this open, but with its smooth weights alone every case would leak into
    # the others.
    dh = h_target - z_ball
    v_desired = 0.5
    v_up = np.where((v_z > 0) & (z_ball < h_target), sqrt(maximum(0, v_z**2 - 2 * g * dh)), 0.0)
    v_down = np.where(
        (v_z < 0) & (z_ball > h_target), -sqrt(maximum(0, v_z**2 + 2 * g * np.abs(dh))), 0.0
    )
    v_near = np.where(np.abs(dh) < 0.05, v_z, 0.0)
    sigma_up = 1 / (1 + exp(-v_z / 0.2))
    sigma_below = 1 / (1 + exp(-dh / 0.02))
    sigma_down = 1 - sigma_up
    sigma_above = 1 - sigma_below
    w_near = exp(-(dh**2) / (2 * 0.01**2))
    v_at_target = (
        v_up * sigma_up * sigma_below + v_down * sigma_down * sigma_above + v_near * w_near
    )
    err_vel = np.abs(v_at_target - v_desired)
    r_vel = exp(-(err_vel**2) / (2 * 0.8**2))

    # 4. Height
    err_h = np.abs(z_ball - h_target)
    r_h = exp(-(err_h**2) / (2 * 0.15**2))

    # 5. Height progress
    r_progress = maximum(0, z_ball - 0.2) * 2.0

    # 6. Controlled upward velocity
    q_pos = exp(-(err_xy**2) / (2 * 0.02**2))
    v_ideal = np.clip(sqrt(2 * g * maximum(0, dh)), 0.5, 3.0)
    q_vel = exp(-((v_z - v_ideal) ** 2) / (2 * 0.5**2))
    upward_mask = 1 / (1 + exp(-v_z / 0.1))
    r_controlled = q_pos * q_vel * upward_mask * np.clip(v_z, 0, 1.5)

    # 7. Consecutive bounces
    q_bounce = exp(-(err_xy**2) / (2 * 0.05**2))
    r_bounce_log = 0.5 * log(n_bounces + 1)
    r_bounce = r_bounce_log * q_bounce * (n_bounces > 0)

    # 8. High bounce count
    sigma_high = 1 / (1 + exp(-(n_bounces - 2.0) / 0.5))
    r_high = n_bounces * 0.15 * q_bounce * sigma_high

    # 9. Paddle-ball horizontal alignment
    err_align = sqrt((x_ball - x_paddle) ** 2 + (y_ball - y_paddle) ** 2)
    w_prox = exp(-d_vert / 0.1)
    q_align = exp(-(err_align**2) / (2 * 0.03**2)) * (1.0 + 2.0 * w_prox)
    k_boost = np.where(bounced, 3.0, 1.0)
    r_align = q_align * k_boost * 0.3

    # 10. Paddle home position
    err_home = np.abs(z_paddle - 0.05)
    k_dist = 1.0 + 0.5 / (1 + exp(-(d_vert - 0.15) / 0.03))
    q_home = exp(-(err_home**2) / (2 * 0.05**2))
    r_home = q_home * k_dist

    # Penalty 1. Excessive upward velocity
    r_excess = -1.0 / (1 + exp(-(v_z - 3.5) / 0.3))

    # Penalty 2. Downward velocity, with the formula's sign: positive for a falling ball
    mag_down = -v_z * np.clip(-v_z * 0.3, 0, 0.5)
    r_down = mag_down * (1 / (1 + exp((v_z + 0.2) / 0.2)))

    # Penalty 3. Paddle height violation
    viol_height = maximum(0, err_home - 0.1)
    r_violation = -20.0 * viol_height

    # Penalty 4. Action change rate
    r_action = -np.sum((a_t - a_previous) ** 2, axis=1)

    # Penalty 5. Joint velocity
    r_joint_vel = -np.sum(q_dot**2, axis=1)

    return {
        "position": r_pos,
        "out_of_position": r_out,
        "velocity_matching": r_vel,
        "height": r_h,
        "height_progress": r_progress,
        "controlled_upward": r_controlled,
        "consecutive_bounces": r_bounce,
        "high_bounce_count": r_high,
        "alignment": r_align,
        "paddle_home": r_home,
        "excessive_upward": r_excess,
        "downward_velocity": r_down,
        "paddle_height_violation": r_violation,
        "action_rate": r_action,
        "joint_velocity": r_joint_vel,
    }
