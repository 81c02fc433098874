"""Policies outside the simulation: ONNX files, and the NumPy code that runs them.

Two invariants hold, whatever a robot's sensors say:

1. A command moves no farther in a control step than the arm may. Every command but the first
   after a reset is made by `motion.Motion`: by `aim` within `Metadata.largest_step` of the last
   one, by `hold` within the limits. The first one is where the arm is said to rest, where its
   controller holds it, or where it is measured near its start pose.
2. What cannot be true is no measurement. What is missing, not finite or of another shape is refused
   by `driver.Driver.check`; every other sample passes `samples.Samples.take`, which bridges what
   cannot be true, while it is at most a third of the last 0.1 s.

A policy is a function of its memory (`controller.Controller.step`), and a refused sample leaves the
memory as it was. `flight` says whether a ball falls, `rest` where an arm rests, `clock` how many
control steps have passed; what an arm does with its commands is watched by `faults.Watch`.
"""
