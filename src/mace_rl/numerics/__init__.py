"""What computes and knows nothing of reinforcement learning: arrays, networks, Adam, neighbours."""
