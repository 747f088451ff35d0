"""Learned failure policies: who is taught to make a system fail, in its likeliest ways."""

from jast._doors import dir_function
from jast.policies.failure_policy import FailurePolicy, History
from jast.policies.proximal_policy import ppo
from jast.policies.q_learning_policy import q_learning
from jast.policies.soft_actor_critic import sac
from jast.policies.storage import load, save

__all__ = ["FailurePolicy", "History", "load", "ppo", "q_learning", "sac", "save"]

__dir__ = dir_function(__all__)
