"""Tasks that are not the maze: any Gymnasium environment, with axes, actions and scales."""
