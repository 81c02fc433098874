"""The training job, the same for every algorithm.

| what | file |
|---|---|
| `train` in Python, and the run that it leaves (`Run`) | `run.py` |
| the loop, what it does (`Job`), signals | `job.py` |
| what the job asks of an algorithm's trainer (`Trainer`) | `trainer.py` |
| the trainer of PPO | `ppo_trainer.py` |
| the evaluations, compiled | `evaluators.py` |
| the seeds and the best policy of each | `seeds.py` |
| saves in the background | `saving.py` |
| several processes, one per host, that agree | `hosts.py` |
| what the job tells, to callbacks and on the console | `events.py` |
| callbacks: TensorBoard, a page, videos | `log.py`, `watch.py`, `video.py` |
| what ends a training with a sentence | `faults.py` |
| the time of each phase | `clock.py` |
| JAX's settings in a command | `setup.py` |
"""
