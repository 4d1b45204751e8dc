"""Learning algorithms, one class per file. `mjxball.algorithms.base` defines the interface to the trainer."""

# Names that `train.py --algorithm` accepts besides package.module:Class. Each has a section of settings of that name.
ALGORITHMS = {
    "sac": "mjxball.algorithms.sac:SoftActorCritic",
    "ppo": "mjxball.algorithms.ppo:ProximalPolicyOptimization",
    "gradient": "mjxball.algorithms.gradient:FirstOrderGradient",
}
