"""The environment with the interfaces of other libraries. A class wraps an `Env`, which
`bounce_mjx.environment` makes (`deploy/environments.py`), and has it as `core`; or it wraps another
class of these, as said:

| library | class | in |
|---|---|---|
| Gymnasium | `TaskEnv`, `TaskVectorEnv` | `gymnasium/environments.py` |
| Stable-Baselines3, SBX | `Sb3VecEnv`, around a `TaskVectorEnv` | `sb3.py` |
| PyTorch | `TorchVectorEnv` | `torch/vector_env.py` |
| rsl_rl | `RslRlVecEnv`, around a `TorchVectorEnv` | `torch/rsl_rl_env.py` |
| skrl | `SkrlEnv`, around a `TorchVectorEnv` | `torch/skrl_env.py` |
| brax, and TorchRL through it | `BraxTaskEnv` | `brax/environment.py` |
| MuJoCo Playground | `PlaygroundTaskEnv` | `playground/environment.py` |
| gymnax, PureJaxRL | `GymnaxTaskEnv`, `PureJaxRLTaskEnv` | `gymnax_env.py` |

`Run.policy_in` acts in any of these with a policy, also below wrappers; it finds the `Env` by
`core`, and by the names that libraries give to what they wrap (`deploy/wrappers.py`). For a policy
in an .onnx file, `deploy.loading.load_policy(env=...)` checks the same.

What belongs to a library that need not be installed is imported from its own file.
"""
