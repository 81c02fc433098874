"""The algorithm: PPO and what it needs.

    ppo.py         PPO: collect, advantages, update; a subclass may replace each method
    policy.py      the policy, its network and the value network
    statistics.py  running statistics of the networks' inputs, and normalisation with them
    metrics.py     the learning curves: what a rollout was worth
    config.py      the settings
    registry.py    how an algorithm is found by its name

It knows an environment by the interface `env.vector.AnyEnv` and by the names of metrics in
`env.contract` alone.
"""
