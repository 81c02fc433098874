"""Policies outside the simulation: ONNX files, and the NumPy code that runs them.

Two invariants hold, whatever a robot's sensors say:

1. A command moves no farther in a control step than the arm may. Every command but the first after
   a reset is made by `motion.Motion.aim`, which is within `Metadata.largest_step` of the last one;
   the first one is aimed from where the arm is measured, or said to rest (`reset`). Under a
   supervisor, which alone gives the policy's commands, only a stop and `restart(moved=True)` make
   another first one.
2. What cannot be true is no measurement. What is missing, not finite or of another shape is refused
   by `policy.DeployedPolicy.check`; every other sample passes `samples.Samples.take`, which bridges
   one that cannot be true, and refuses a second one in a row.

What an arm does with its commands, and what becomes of the ball, is watched by `faults.Watch`.
"""
