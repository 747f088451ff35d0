"""Failure policies: trained by reinforcement learning to make a system fail in likely ways."""

from jast._src.io.save_load import load, save
from jast._src.policies.failure_policy import FailurePolicy, History
from jast._src.policies.proximal_policy import ppo
from jast._src.policies.q_learning_policy import q_learning
from jast._src.policies.soft_actor_critic import sac
from jast._src.util.doors import dir_function

__all__ = ["FailurePolicy", "History", "load", "ppo", "q_learning", "sac", "save"]

__dir__ = dir_function(__all__)
