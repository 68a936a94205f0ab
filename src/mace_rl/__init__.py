"""MACE-RL: PPO with episodic memory, curiosity and a meta-learnt curiosity weight β."""
