"""Settings of the learning algorithms, one section for each name of `train.py --algorithm`."""

# Without `from __future__ import annotations`: the type of a field is read, and is no text.
from dataclasses import dataclass

from mjxball.config._leaf import setting

ESTIMATION = (
    "weight of the squared error of a linear estimate, from a recurrent network's state, of what critics alone observe "
    "(follower.privileged_critic), each over its deviation; trains the memory, and is not exported"
)


@dataclass(frozen=True)
class Sac:
    """Soft actor-critic and its training loop."""

    total_steps: int = setting(1_000_000, "environment steps in all", low=1, high=10**12)
    num_envs: int = setting(128, "environments stepped in parallel", low=1, high=10**7)
    batch_size: int = setting(256, "transitions in an update", low=1, high=10**8)
    updates_per_step: int = setting(4, "gradient updates after each step of all environments", low=1, high=100_000)
    warmup_steps: int = setting(
        12_800, "environment steps with random actions before the first update", low=0, high=10**12
    )
    replay_size: int = setting(1_024_000, "transitions kept, a multiple of num_envs", low=1, high=10**10)
    policy_layers: tuple[int, ...] = setting((64, 64), "hidden layers of the policy", low=1, high=100_000)
    recurrent_steps: int = setting(
        16,
        "consecutive steps through which a recurrent policy is trained; batch_size is a multiple",
        low=1,
        high=100_000,
    )
    estimation: float = setting(0.0, ESTIMATION, low=0, high=1e6)
    critic_layers: tuple[int, ...] = setting((64, 64), "hidden layers of each critic", low=1, high=100_000)
    critic_layer_norm: bool = setting(False, "LayerNorm in the critics")
    num_critics: int = setting(2, "Q networks; the smallest of their values is used", low=1, high=2)
    state_value: bool = setting(
        False, "targets from a state-value network with a slow copy (the paper's eqs. 6-8), not from slow Q networks"
    )
    learning_rate: float = setting(1e-3, "Adam's rate for policy and critics", low=1e-12, high=1)
    discount: float = setting(0.99, "gamma", low=0, high=0.99999)
    n_step: int = setting(1, "rewards summed before bootstrapping (n-step returns)", low=1, high=50)
    tau: float = setting(0.02, "update rate of the target networks", low=1e-9, high=1)
    alpha: float = setting(0.02, "temperature at the start", low=1e-12, high=1e6)
    alpha_fixed: bool = setting(False, "keep the temperature at its start")
    target_entropy: float = setting(-0.5, "target entropy per action dimension [nat]", low=-1e4, high=1e4)
    reward_scale: float = setting(1.0, "factor on the reward inside the critic", low=1e-9, high=1e9)
    num_evaluations: int = setting(5, "evaluations, each with a checkpoint, evenly over the run", low=1, high=50)
    learning_rate_final_ratio: float = setting(
        0.1, "rate at the end of the run over the rate at its start", low=1e-12, high=1
    )


@dataclass(frozen=True)
class Ppo:
    """Proximal policy optimisation, with `train.py --algorithm ppo`."""

    total_steps: int = setting(4_000_000, "environment steps in all", low=1, high=10**12)
    num_envs: int = setting(512, "environments stepped in parallel", low=1, high=10**7)
    unroll_length: int = setting(20, "steps of an unroll, over which advantages are estimated", low=1, high=100_000)
    minibatches: int = setting(8, "minibatches in each pass over the unrolls", low=1, high=100_000)
    policy_layers: tuple[int, ...] = setting((64, 64), "hidden layers of the policy", low=1, high=100_000)
    learning_rate: float = setting(2e-3, "Adam's rate at the start", low=1e-12, high=1)
    discount: float = setting(0.97, "gamma", low=0, high=0.99999)
    entropy_cost: float = setting(0.0, "weight of the policy's entropy", low=0, high=1e6)
    num_evaluations: int = setting(5, "evaluations, each with a checkpoint, evenly over the run", low=1, high=50)


@dataclass(frozen=True)
class Gradient:
    """First-order gradients through the closed form, with `train.py --algorithm gradient`."""

    gradient_steps: int = setting(120, "steps of Adam, each on one window of all environments", low=1, high=10**8)
    num_envs: int = setting(32, "environments simulated in parallel", low=1, high=10**7)
    horizon: int = setting(100, "control steps of a window, the length of backpropagation", low=1, high=100_000)
    windows_per_episode: tuple[int, ...] = setting(
        (4,),
        "windows after which an environment is reset; several numbers alternate over environments",
        low=1,
        high=100_000,
    )
    policy_layers: tuple[int, ...] = setting((64, 64), "hidden layers of the policy", low=1, high=100_000)
    learning_rate: float = setting(2e-2, "Adam's rate at the start", low=1e-12, high=1)
    learning_rate_final_ratio: float = setting(
        0.02, "rate at the end of the run over the rate at its start", low=1e-12, high=1
    )
    adam_betas: tuple[float, float] = setting(
        (0.9, 0.999), "Adam's decay rates of the means of gradients and of their squares", low=0, high=0.99999
    )
    gradient_decay: float = setting(1.0, "factor on the gradient at each control step backwards", low=1e-6, high=1)
    state_gradient_clip: float = setting(
        0.0,
        "largest norm of the gradient with respect to the state of one environment at each control step backwards, in "
        "units of 1 / (horizon num_envs); 0: no limit",
        low=0,
        high=1e12,
    )
    impulse_response: float = setting(
        0.0,
        "weight of the logarithm of the linearised closed loop's response to an impulse of a window's first action, "
        "which damps oscillations too small for the reward; used in the last quarter of the gradient steps, which "
        "take three times as long",
        low=0,
        high=1e6,
    )
    estimation: float = setting(0.0, ESTIMATION, low=0, high=1e6)
    exchanged_memory: float = setting(
        0.0,
        "probability that a window begins with the recurrent state of another environment, so that a network learns to "
        "correct its memory within a window and does not drift in flights longer than one",
        low=0,
        high=1,
    )
    num_evaluations: int = setting(1, "evaluations, each with a checkpoint, evenly over the run", low=1, high=50)
