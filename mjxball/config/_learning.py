"""Settings of the learning algorithms; the name of each section is that of `train.py --algorithm`."""

# Without `from __future__ import annotations`: the type of a field is read, and is no text.
from dataclasses import dataclass

from mjxball.config._leaf import setting


@dataclass(frozen=True)
class Sac:
    """Soft actor-critic and the loop around it."""

    total_steps: int = setting(1_000_000, "environment steps in all", low=1, high=10**12)
    num_envs: int = setting(128, "environments that are stepped at once", low=1, high=10**7)
    batch_size: int = setting(256, "transitions in an update", low=1, high=10**8)
    updates_per_step: int = setting(4, "gradient updates after each step of all environments", low=1, high=100_000)
    warmup_steps: int = setting(
        12_800, "environment steps with random actions before the first update", low=0, high=10**12
    )
    replay_size: int = setting(1_024_000, "transitions kept, a multiple of num_envs", low=1, high=10**10)
    policy_layers: tuple[int, ...] = setting((64, 64), "hidden layers of the policy", low=1, high=100_000)
    recurrent_steps: int = setting(
        16,
        "steps in a row from which a recurrent policy learns what to remember; batch_size is a multiple",
        low=1,
        high=100_000,
    )
    critic_layers: tuple[int, ...] = setting((64, 64), "hidden layers of each critic", low=1, high=100_000)
    critic_layer_norm: bool = setting(False, "LayerNorm in the critics")
    num_critics: int = setting(2, "Q networks, of which the smallest value counts", low=1, high=2)
    state_value: bool = setting(
        False, "a state-value network with a slow copy gives the targets (the paper's eqs. 6-8), not slow Q networks"
    )
    learning_rate: float = setting(1e-3, "Adam's rate for policy and critics", low=1e-12, high=1)
    discount: float = setting(0.99, "gamma", low=0, high=0.99999)
    n_step: int = setting(1, "rewards summed before bootstrapping (n-step returns)", low=1, high=50)
    tau: float = setting(0.02, "rate of the slow copies that give the targets", low=1e-9, high=1)
    alpha: float = setting(0.02, "temperature at the start", low=1e-12, high=1e6)
    alpha_fixed: bool = setting(False, "keep the temperature at its start")
    target_entropy: float = setting(-0.5, "wanted entropy for each action dimension [nat]", low=-1e4, high=1e4)
    reward_scale: float = setting(1.0, "factor on the reward inside the critic", low=1e-9, high=1e9)
    num_evaluations: int = setting(5, "evaluations, each with a checkpoint, evenly over the run", low=1, high=50)
    learning_rate_final_ratio: float = setting(
        0.1, "rate at the end of the run over the rate at its start", low=1e-12, high=1
    )


@dataclass(frozen=True)
class Ppo:
    """Proximal policy optimisation, with `train.py --algorithm ppo`."""

    total_steps: int = setting(4_000_000, "environment steps in all", low=1, high=10**12)
    num_envs: int = setting(512, "environments that are stepped at once", low=1, high=10**7)
    unroll_length: int = setting(20, "steps in a row whose advantages are estimated together", low=1, high=100_000)
    minibatches: int = setting(8, "parts of the unrolls that each pass over them is cut into", low=1, high=100_000)
    policy_layers: tuple[int, ...] = setting((64, 64), "hidden layers of the policy", low=1, high=100_000)
    learning_rate: float = setting(2e-3, "Adam's rate at the start", low=1e-12, high=1)
    discount: float = setting(0.97, "gamma", low=0, high=0.99999)
    entropy_cost: float = setting(0.0, "weight of the policy's entropy", low=0, high=1e6)
    num_evaluations: int = setting(5, "evaluations, each with a checkpoint, evenly over the run", low=1, high=50)


@dataclass(frozen=True)
class Gradient:
    """First-order gradients through the closed form, with `train.py --algorithm gradient`."""

    gradient_steps: int = setting(120, "steps of Adam, each on one window of all environments", low=1, high=10**8)
    num_envs: int = setting(32, "environments that are flown at once", low=1, high=10**7)
    horizon: int = setting(
        100, "control steps of a window, through which the reward is differentiated", low=1, high=100_000
    )
    windows_per_episode: tuple[int, ...] = setting(
        (4,),
        "windows after which an environment starts anew; of several numbers environments have one each",
        low=1,
        high=100_000,
    )
    policy_layers: tuple[int, ...] = setting((64, 64), "hidden layers of the policy", low=1, high=100_000)
    learning_rate: float = setting(2e-2, "Adam's rate at the start", low=1e-12, high=1)
    learning_rate_final_ratio: float = setting(
        0.02, "rate at the end of the run over the rate at its start", low=1e-12, high=1
    )
    adam_betas: tuple[float, float] = setting(
        (0.9, 0.999), "what Adam keeps in a step of its means of gradients and of their squares", low=0, high=0.99999
    )
    gradient_decay: float = setting(
        1.0, "factor on the gradient that passes from a control step to the one before", low=1e-6, high=1
    )
    state_gradient_clip: float = setting(
        0.0,
        "largest length of the gradient that passes through one environment's state from a control step to the one "
        "before, in units of 1 / (horizon num_envs); 0: no limit",
        low=0,
        high=1e12,
    )
    impulse_response: float = setting(
        0.0,
        "weight of the logarithm of the closed loop's linearised answer to an impulse of a window's first action: it "
        "is to die out also where errors are too small to cost anything; it counts in the last quarter of the "
        "gradient steps, which take three times as long",
        low=0,
        high=1e6,
    )
    num_evaluations: int = setting(1, "evaluations, each with a checkpoint, evenly over the run", low=1, high=50)
