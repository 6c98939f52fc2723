"""Named settings: ``default``, what works best, and ``paper``, every number as printed."""

import dataclasses

from sofnn_torch.runs.settings import Config, MazeConfig, NetworkConfig, QConfig, SGAConfig


def preset(agent: str, network: str, name: str) -> Config:
    """The settings of a named preset for one of the four learners.

    Raises:
        ValueError: an unknown name.
    """
    known = name in ("default", "paper") and agent in ("sga", "q")
    if not known or network not in ("sofnn", "fixed"):
        raise ValueError(f"no preset {name!r} for agent {agent!r} and network {network!r}")
    if name == "paper":
        return _paper(agent, network)
    net = NetworkConfig()
    if agent == "q":  # greedy action values need sharper sets: wide ones reach through walls
        net = NetworkConfig(theta=0.3, width_position=0.045, width_heading=0.4)
    if network == "fixed":  # half the grid's spacing
        net = dataclasses.replace(net, width_position=0.042, width_heading=0.39)
    if agent == "sga":
        return Config(agent="sga", network=network, net=net)
    return Config(
        agent="q",
        network=network,
        net=net,
        maze=MazeConfig(goal_reward=100.0, collision_reward=-0.1, subgoal_reward=0.5),
    )


def _paper(agent: str, network: str) -> Config:
    """Every number as printed; where the paper is silent, the reading of docs/paper.md."""
    net = NetworkConfig(theta=0.5)
    sga_settings = SGAConfig(
        trace_decay=1.0,
        baseline="constant",
        rate_mean=0.05,
        rate_deviation=0.001,
        rate_centre=0.001,
        rate_width=0.001,
        one_minus_gamma=True,
        variance_scaled=False,
        value_limit=None,
        replays=0,
    )
    q_settings = QConfig(
        coding="antecedent",
        trace_decay=0.0,
        trace_cut=False,
        trace_limit=None,
        value_limit=None,
        rate_state=0.1,
        rate_action=0.1,
        rate_constant=0.1,
        rate_centre=0.001,
        rate_width=0.001,
        initial=0.0,
        replays=0,
    )
    rewards = (1.0, -1e-4) if agent == "sga" else (100.0, -0.1)
    maze = MazeConfig(
        dead_reckoning="literal",
        goal_reward=rewards[0],
        collision_reward=rewards[1],
        subgoal_reward=0.5,
    )
    return Config(
        agent, network, preset="paper", net=net, sga=sga_settings, q=q_settings, maze=maze
    )
