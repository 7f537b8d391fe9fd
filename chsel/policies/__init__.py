"""Which action to take next: a file for each policy."""

from chsel.policies.policy_registry import OURS, POLICIES, build_policy, policy_settings

__all__ = ["OURS", "POLICIES", "build_policy", "policy_settings"]
