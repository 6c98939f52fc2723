"""The self-organizing fuzzy neural network by itself (section 2 of the paper)."""
