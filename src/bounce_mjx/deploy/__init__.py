"""Policies outside the simulation: ONNX files, and the NumPy code that runs them.

Two invariants hold, whatever a robot's sensors say:

1. A command moves no farther in a control step than the arm may. Every command is made by
   `motion.Motion.aim`, which is within `Metadata.largest_step` of the last one.
2. What cannot be true is no measurement. Every sample passes `samples.Samples.take`, which bridges
   one that cannot be true, and refuses a second one in a row.

What an arm does with its commands, and what becomes of the ball, is watched by `faults.Watch`.
"""
