"""Robot and maze of the simulation (section 5), as a Gymnasium environment."""
