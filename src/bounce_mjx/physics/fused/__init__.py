"""The fused engine: MuJoCo's equations for one kind of model, as straight-line scalar arithmetic.

The supported kind: a serial chain of hinges and slides with position servos, one to three free
balls (`robot/model.py` limits their number), contact pairs of each ball (a sphere) with the paddle
(a box) and of the balls with each other, with or without sliding friction, and the integrator
implicitfast or Euler. `physics/support.py` names what a compiled `mujoco.MjModel` has beyond that;
`model.read_model` reads the constants of one without.

Read `forward.py` first: a physics step in MuJoCo's stages.
"""
