"""Learning algorithms: one class in one file each. `mjxball.algorithms.base` says what the trainer asks of it."""

# Names that `train.py --algorithm` takes beside package.module:Class; each has the section of settings of its name.
ALGORITHMS = {
    "sac": "mjxball.algorithms.sac:SoftActorCritic",
    "ppo": "mjxball.algorithms.ppo:ProximalPolicyOptimization",
    "gradient": "mjxball.algorithms.gradient:FirstOrderGradient",
}
