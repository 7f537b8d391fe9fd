"""Which action to take next."""

from chsel.policies.policies import OURS, POLICIES, build_policy, policy_settings

__all__ = ["OURS", "POLICIES", "build_policy", "policy_settings"]
