"""Follower policies as plain NumPy. Imports NumPy and `control/` only: no JAX, no MuJoCo.

policy = Policy.load("policies/balance.npz")
roll, pitch, vertical_acceleration = policy(observation)  # SI units
"""

from mjxball.policy.container import PolicyFileError
from mjxball.policy.file import (
    PolicyFile,
    load_file,
    load_network,
    policy_name,
    policy_path,
    save_file,
    shipped_policies,
    shipped_policy,
)
from mjxball.policy.inference import Policy

__all__ = [
    "Policy",
    "PolicyFile",
    "PolicyFileError",
    "load_file",
    "load_network",
    "policy_name",
    "policy_path",
    "save_file",
    "shipped_policies",
    "shipped_policy",
]
