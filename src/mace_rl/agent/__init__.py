"""The PPO agent: policy, critics, their networks and the update."""
