"""What a training begins with, its settings, its folder, and what is found in it.

| what | file |
|---|---|
| a user's word: a task, a policy or a run, which fixes the classes (`Start`) | `start.py` |
| the layers of settings on it, their order (`Rank`), merged and validated once | `layers.py` |
| files by name: presets, robots, worlds; the machine's preset | `presets.py` |
| the settings of an environment (`WorldConfig`) of a task or a policy, in a world | `worlds.py` |
| all settings of a training (`TrainConfig`), and those of a run, read again | `config.py` |
| what a run's folder begins with | `creation.py` |
| what a run's folder holds, and what finds runs and checkpoints | `folders.py` |
| a run, for a user of Python (`Run`) | `training/run.py` |
| where a checkpoint is (`Checkpoint`), and what it says of itself (`Record`) | `records.py` |
| the arrays of a checkpoint, read and written | `checkpoints.py` |
| the evaluations so far, and when results end a training | `progress.py` |
| files that are complete or not there, manifests, the lock of a run | `storage.py` |
"""
