"""What learns by reinforcement on the network: SGA (section 3), Q-learning (section 4)."""
