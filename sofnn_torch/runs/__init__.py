"""One run: its settings, its directory, its checkpoints, and what may cut it short."""
